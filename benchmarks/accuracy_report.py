# SPDX-License-Identifier: Apache-2.0
"""Table of what `accuracy.py` measured."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import bench  # noqa: F401  (before NumPy)
import numpy as np

from uav_ident_ros.identification.structure import FloatArray

CLIP = -50.0
"""Fit at which a cell is clipped in averages, percent."""

CellRow = Mapping[str, Any]
Key = tuple[str, str]

HOLD = ("", "hold the last rate")
NLMS = "padasip NLMS"
DEFAULT = "instrumental_variable"
REFERENCE = "output error"


def table(cells: Sequence[CellRow]) -> str:
    """Every flight in turn, then the averages and the distance from the output-error fit."""
    cells = _best_in_hindsight(cells)
    lines = []
    for flight in dict.fromkeys(cell["flight"] for cell in cells):
        lines += _flight_table([cell for cell in cells if cell["flight"] == flight])
    return "\n".join(lines + _summary(cells) + _against_output_error(cells))


def in_short(cells: Sequence[CellRow]) -> str:
    """Say how the default and the reference did, in a line."""
    parts = []
    for (structure, method), group in _grouped(cells).items():
        if method in (DEFAULT, REFERENCE):
            fits = "/".join(f"{value:.1f}" for value in _mean([c["model"] for c in group]))
            parts.append(f"{structure} {method} {fits}")
    return f"{cells[0]['flight']} seed {cells[0]['seed']}: " + "; ".join(parts)


def _best_in_hindsight(cells: Sequence[CellRow]) -> list[CellRow]:
    """Leave, for each structure, only the NLMS step that did best over all flights."""
    best: dict[str, tuple[float, str]] = {}
    for (structure, method), group in _grouped(cells).items():
        if method.startswith(NLMS):
            fit = float(np.maximum([cell["model"] for cell in group], CLIP).mean())
            best[structure] = max(best.get(structure, (-np.inf, "")), (fit, method))
    return [
        cell
        for cell in cells
        if not cell["method"].startswith(NLMS) or cell["method"] == best[cell["structure"]][1]
    ]


def _grouped(cells: Iterable[CellRow]) -> dict[Key, list[CellRow]]:
    groups: dict[Key, list[CellRow]] = defaultdict(list)
    for cell in cells:
        groups[cell["structure"], cell["method"]].append(cell)
    return groups


def _flight_table(cells: Sequence[CellRow]) -> list[str]:
    seeds = sorted({cell["seed"] for cell in cells if cell["seed"] is not None})
    title = f"{cells[0]['flight']}" + (f", seeds {seeds[0]} to {seeds[-1]}" if seeds else "")
    heading = f"{'':54}{'measured rates':^30}{'noise-free rates':^22}{'six, %':>8}"
    lines = ["", title, heading]
    hold = _mean([cell["hold"] for cell in cells])
    lines.append(f"{HOLD[1]:54}{_three(hold)}")
    for (structure, method), group in _grouped(cells).items():
        fits = np.array([cell["model"] for cell in group])
        spread = f"±{fits.std(axis=0).max():4.1f}" if len(fits) > 1 else ""
        truth = _mean([cell["truth"] for cell in group])
        known = "" if np.isnan(truth).all() else _three(truth)
        error = float(np.mean([cell["coefficient_error"] for cell in group]))
        worst = "" if np.isnan(error) else f"{error:8.1f}"
        label = f"{structure:12}{method}"
        lines.append(f"{label:54}{_three(_mean(fits))} {spread:8}{known:22}{worst}")
    return lines


def _mean(values: Sequence[Sequence[float]] | FloatArray) -> FloatArray:
    return np.asarray(np.asarray(values, dtype=float).mean(axis=0))


def _three(values: FloatArray) -> str:
    return "".join(f"{value:7.1f}" for value in values)


def _summary(cells: Sequence[CellRow]) -> list[str]:
    """Mean over flights and axes, each cell clipped, by family of flights."""
    families = {
        "exact": [c for c in cells if c["flight"].startswith("exact")],
        "JSBSim": [c for c in cells if c["seed"] is not None and "exact" not in c["flight"]],
        "real": [c for c in cells if c["seed"] is None],
    }
    families = {name: group for name, group in families.items() if group}
    lines = ["", f"Mean of all axes and flights, each clipped at {CLIP:g} (cells at or below it)"]
    lines.append(f"{'':54}" + "".join(f"{name:>16}" for name in families))
    lines.append(f"{HOLD[1]:54}" + "".join(_clipped(g, "hold") for g in families.values()))
    for key in _grouped(cells):
        row = []
        for group in families.values():
            chosen = [c for c in group if (c["structure"], c["method"]) == key]
            row.append(_clipped(chosen, "model") if chosen else f"{'':16}")
        lines.append(f"{key[0]:12}{key[1]:42}" + "".join(row))
    return lines


def _clipped(cells: Sequence[CellRow], field: str) -> str:
    fits = np.array([cell[field] for cell in cells])
    return f"{np.maximum(fits, CLIP).mean():11.1f} ({int((fits <= CLIP).sum()):2})"


def _against_output_error(cells: Sequence[CellRow]) -> list[str]:
    """Online minus offline fit of the same structure, seeds averaged; the worst cell named."""
    groups: dict[tuple[str, str, str], list[Sequence[float]]] = defaultdict(list)
    for cell in cells:
        groups[cell["structure"], cell["method"], cell["flight"]].append(cell["model"])
    means = {key: np.maximum(_mean(fits), CLIP) for key, fits in groups.items()}
    lines = ["", "Online minus offline output error, same structure: mean, worst cell"]
    for structure, method in _grouped(cells):
        if method == REFERENCE or (structure, REFERENCE) not in _grouped(cells):
            continue
        gaps = {
            flight: means[structure, method, flight] - means[structure, REFERENCE, flight]
            for s, m, flight in groups
            if (s, m) == (structure, method)
        }
        worst = min(gaps, key=lambda flight: float(gaps[flight].min()))
        mean = float(np.mean(list(gaps.values())))
        axis = "pqr"[int(gaps[worst].argmin())]
        lines.append(
            f"{structure:12}{method:42}{mean:8.1f}{gaps[worst].min():8.1f}  {worst} {axis}"
        )
    return lines
