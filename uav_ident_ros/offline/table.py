# SPDX-License-Identifier: Apache-2.0
"""The results of a replay in words and columns."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator

import numpy as np

from uav_ident_ros.files.meanings import MEANINGS
from uav_ident_ros.identification.prediction import HORIZONS, PredictionFit
from uav_ident_ros.identification.structure import ROWS
from uav_ident_ros.offline.summary import AXES, Replayed, streams

WIDTH = 100
"""Columns of the longest line."""

_TITLES = {
    "last_40_percent": "over the last 40 % of the flight",
    "after_30_s": "after 30 s",
}


def write_table(replayed: Replayed) -> str:
    """Return the results of a replay in words and columns."""
    parts = [
        _heading(replayed),
        _coefficients(replayed),
        *(_fit_lines(_TITLES[windows], fit) for windows, fit in replayed.fits.items()),
        _modes(replayed),
        _verdict(replayed),
    ]
    return "\n\n".join(filter(None, ("\n".join(lines) for lines in parts)))


def _heading(replayed: Replayed) -> Iterator[str]:
    """Yield what was replayed, and how."""
    run = replayed.run
    last, settings = run.estimates[-1], run.inputs.settings
    seconds = (last.t_ns - run.estimates[0].t_ns) * 1e-9
    yield f"{replayed.name}: {seconds:.1f} s, {len(run.estimates)} ticks"
    yield f"structure {settings.structure}, estimator {settings.estimator}"
    yield f"state at the end: {last.state}{f' ({last.reason})' if last.reason else ''}"
    for stream, topic, msgtype in streams(run.inputs):
        refusals = run.refusals(stream)
        dropped = "".join(f", {count} {reason}" for reason, count in refusals.dropped.items())
        yield f"{stream}: {topic} ({msgtype}), {refusals.received} messages{dropped}"
    if settings.actuators.estimate_delay:
        sigma = _sigma(run.identifier.delay_sigma)
        yield f"estimated delay of the inputs: {run.identifier.delay:.3f} s, sigma {sigma}"
    if settings.airspeed.type:
        yield f"coefficients at the reference airspeed, {settings.airspeed.reference:g} m/s"


def _coefficients(replayed: Replayed) -> Iterator[str]:
    """Yield a row for each coefficient."""
    structure, result = replayed.run.structure, replayed.run.result()
    yield f"{'coefficient':<12}{'value':>12}{'sigma':>12}{'t-ratio':>10}  meaning"
    for name, index in zip(structure.names, structure.free, strict=True):
        value, sigma = float(result.values[index]), float(result.sigma[index])
        numbers = f"{value:>+12.4g}{_sigma(sigma):>12}{_t_ratio(value, sigma):>10}"
        yield f"{name:<12}{numbers}  {MEANINGS[name]}"


def _sigma(sigma: float) -> str:
    if sigma == 0.0:
        return "fixed"
    return f"{sigma:.2g}" if math.isfinite(sigma) else "unknown"


def _t_ratio(value: float, sigma: float) -> str:
    """Return the magnitude in sigmas; a dash where the coefficient is fixed or unknown."""
    return f"{abs(value) / sigma:.1f}" if 0.0 < sigma < math.inf else "-"


def _fit_lines(title: str, fit: PredictionFit) -> Iterator[str]:
    """Yield the fit of each axis beside the baselines."""
    header = f"free prediction, fit {title} [%]"
    if not fit.windows:
        yield f"{header}: no window to score"
        return
    rows = []
    for horizon, model, hold in zip(HORIZONS, fit.free, fit.free_hold, strict=True):
        rows.append((f"identified model, {horizon:g} s", model))
        rows.append(("  holding the rates", hold))
    if np.isfinite(fit.measured_force).any():
        rows.append(("with measured forces, 1 s", fit.measured_force))
    yield f"{header}, {fit.windows} windows"
    yield f"{'':<26}" + "".join(f"{axis:>9}" for axis in AXES)
    for row, values in rows:
        if np.isfinite(values).any():
            yield f"{row:<26}" + "".join(f"{value:>9.1f}" for value in values)


def _modes(replayed: Replayed) -> Iterator[str]:
    """Yield the modes of the model, a line each."""
    found = replayed.modes()
    if found:
        yield "modes of the model, level"
    for mode in found:
        stable = "" if mode.stable else ", unstable"
        if math.isfinite(mode.frequency):
            yield (
                f"{mode.name:<14}{mode.frequency:>8.3g} +- {mode.frequency_sigma:.2g} rad/s, "
                f"damping ratio {mode.damping:.2g} +- {mode.damping_sigma:.2g}{stable}"
            )
        else:
            yield (
                f"{mode.name:<14}{mode.time_constant:>8.3g} +- {mode.time_constant_sigma:.2g} s, "
                f"aperiodic{stable}"
            )


def _verdict(replayed: Replayed) -> Iterator[str]:
    """Yield whether the model is usable, what the bag is like, and what to do."""
    rows = zip(ROWS, replayed.run.estimates[-1].usable_rows, strict=True)
    each = ", ".join(f"{row} {'usable' if usable else 'not'}" for row, usable in rows)
    yield f"verdict: not usable ({each}): {replayed.doubt}" if replayed.doubt else "verdict: usable"
    for word, texts in (
        ("note", replayed.notes),
        ("advice", [advice.text for advice in replayed.advice]),
    ):
        for text in texts:
            yield textwrap.fill(f"{word}: {text}", WIDTH, subsequent_indent="  ")
