# SPDX-License-Identifier: Apache-2.0
"""One picture of a flight: rates beside their predictions, coefficients beside the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import ROWS, FloatArray, Structure

SIZE = (13.0, 8.0)
"""Inches."""

DPI = 110

AXES = "pqr"

DETAIL = 25.0
"""Length of the rates' panels, s: a longer one hides the measurement behind the prediction."""

HEADROOM = 1.3
"""The panels reach so far beyond what they are scaled by: a divergent curve leaves them."""

BAND = 2.0
"""Half width of the band around a coefficient, standard deviations."""

LABEL_GAP = 0.085
"""Least distance of two labels, share of a panel's height: one line of text."""

MEASURED, PREDICTED = "tab:gray", "tab:red"

COLOURS = {
    "p": "tab:blue", "q": "tab:cyan", "r": "tab:green", "de": "tab:purple", "dr": "tab:brown",
    "da": "tab:pink", "beta": "tab:olive", "alpha": "tab:orange",
}  # fmt: skip
"""Regressors that are drawn, each in one colour throughout."""


class PictureError(Exception):
    """A picture cannot be made; the message says why."""


@dataclass(frozen=True)
class Overview:
    """What the picture shows."""

    title: str  # Heading
    horizon: float  # How long before its time a prediction was made, s
    t: FloatArray  # (W,) Times that the predictions are for, s
    # measured, predicted: (W, 3) Rates p q r at these times, rad/s
    measured: FloatArray
    predicted: FloatArray
    tick_t: FloatArray  # (K,) Times of the ticks, s
    # coefficients, sigma: (K, m, n) Coefficients at the ticks and their standard deviations, SI
    coefficients: FloatArray
    sigma: FloatArray
    structure: Structure  # Their structure
    # True coefficients by name, as far as they are known
    truth: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ("", "", "")  # Heading of the panel of each rate, such as its fit


def save_overview(path: Path | str, flight: Overview) -> None:
    """Draw a flight as a PNG.

    Parameters
    ----------
    path : Path or str
        The file.
    flight : Overview
        What to draw.

    Raises
    ------
    PictureError
        If matplotlib is missing or the file cannot be written.
    """
    figure = _figure()
    panels = figure.subplots(3, 2, sharex="col", width_ratios=(1.1, 1.0))
    for axis in range(3):
        _draw_rate(panels[axis][0], axis, flight)
        _draw_coefficients(panels[axis][1], axis, flight)
    for panel in panels[2]:
        panel.set_xlabel("time [s]")
    panels[0][1].set_title(_coefficients_title(flight), fontsize="medium", loc="left")
    handles, labels = panels[0][0].get_legend_handles_labels()
    panels[0][0].legend(handles, labels, loc="upper left", ncols=2, fontsize="small")
    figure.suptitle(flight.title)
    try:
        # Without the software's name and version the same data give the same bytes.
        figure.savefig(path, dpi=DPI, metadata={"Software": None})
    except OSError as error:
        raise PictureError(f"cannot write '{path}': {error.strerror}") from None


def _figure() -> Any:
    """Return an empty figure; no window system is needed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise PictureError("pictures need matplotlib (python3-matplotlib)") from None
    figure = Figure(figsize=SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _coefficients_title(flight: Overview) -> str:
    truth = ", dashed: truth" if flight.truth else ""
    return f"coefficients [SI], band: ±{BAND:g} standard deviations{truth}"


def _draw_rate(panel: Any, axis: int, flight: Overview) -> None:
    """Draw the end of the flight: the measurement wide, the prediction thin on top of it."""
    end = float(flight.t.max(initial=0.0))
    shown = flight.t >= end - DETAIL
    t, measured = flight.t[shown], flight.measured[shown, axis]
    panel.plot(t, measured, color=MEASURED, alpha=0.55, linewidth=3.5, label="measured")
    panel.plot(
        t, flight.predicted[shown, axis],
        color=PREDICTED, linewidth=1.0, label=f"predicted {flight.horizon:g} s before",
    )  # fmt: skip
    # without samples, or at rest, there is no scale
    limit = HEADROOM * max(float(np.abs(measured).max(initial=0.0)), 1e-3)
    panel.set_ylim(-limit, limit)
    panel.set_ylabel(f"{AXES[axis]} [rad/s]")
    if flight.notes[axis]:
        panel.set_title(f"{AXES[axis]}: {flight.notes[axis]}", fontsize="medium", loc="left")
    panel.grid(alpha=0.3)


def _draw_coefficients(panel: Any, row: int, flight: Overview) -> None:
    """Draw the damping and control derivatives of a row, each with its band and its truth."""
    structure = flight.structure
    shown = {
        structure.regressors[j]: (flight.coefficients[:, row, j], flight.sigma[:, row, j])
        for i, j in structure.free
        if i == row and structure.regressors[j] in COLOURS
    }
    truth = {name: flight.truth.get(f"{ROWS[row]}/{name}") for name in shown}
    # the first half is where they come from: noise, until they have settled
    settled = [value for values, _ in shown.values() for value in values[len(values) // 2 :]]
    reach = [0.0, *settled, *(value for value in truth.values() if value is not None)]
    low, high = min(reach), max(reach)
    margin = (HEADROOM - 1.0) * max(high - low, 1e-3)
    panel.set_ylim(low - margin, high + margin)
    panel.grid(alpha=0.3)
    labels = []
    for name, (values, sigma) in shown.items():
        colour, half = COLOURS[name], BAND * sigma
        panel.fill_between(
            flight.tick_t, values - half, values + half,
            where=half < high - low + margin, color=colour, alpha=0.25, linewidth=0.0,
        )  # fmt: skip
        panel.plot(flight.tick_t, values, color=colour, linewidth=1.3)
        if truth[name] is not None:
            panel.axhline(truth[name], color=colour, linestyle="--", linewidth=1.1)
        if len(values):
            text = f"{ROWS[row]}/{name}  {with_sigma(values[-1], sigma[-1])}"
            labels.append((float(values[-1]), text, colour))
    _label(panel, labels)


def with_sigma(value: float, sigma: float) -> str:
    """Return a value and its standard deviation, to two figures of the latter."""
    if not (0.0 < sigma < np.inf):
        return f"{value:.3g}"
    places = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{places}f} ± {sigma:.{places}f}"


def _label(panel: Any, labels: list[tuple[float, str, str]]) -> None:
    """Write (value, text, colour) to the right of a panel, each beside its value."""
    labels = sorted(labels)
    low, high = panel.get_ylim()
    wanted = np.array([(value - low) / (high - low) for value, _, _ in labels])
    for y, (_, text, colour) in zip(spread(wanted, LABEL_GAP), labels, strict=True):
        panel.text(
            1.015, y, text, color=colour, transform=panel.transAxes, va="center", fontsize="small"
        )


def spread(wanted: FloatArray, gap: float) -> FloatArray:
    """Return rising places at least `gap` apart, each near the one wanted, shape (n,).

    Parameters
    ----------
    wanted : (n,) array
        Rising places, shares of a height.
    gap : float
        Least distance.
    """
    ranks = gap * np.arange(len(wanted))
    # pushed up by those below, then all down as far as the highest is out
    places = np.maximum.accumulate(wanted - ranks) + ranks
    return np.asarray(places - max(0.0, float(places.max(initial=0.0)) - 1.0))
