# SPDX-License-Identifier: Apache-2.0
"""The results of a replay in words and columns."""

from __future__ import annotations

import math

import numpy as np

from uav_ident_ros.identification.prediction import PredictionFit
from uav_ident_ros.offline import OfflineRun
from uav_ident_ros.replay.summary import AXES, streams

_TITLES = {
    "last_40_percent": "over the last 40 % of the flight",
    "after_30_s": "after 30 s",
}


def write_table(name: str, run: OfflineRun, fits: dict[str, PredictionFit]) -> str:
    """Results in words and columns."""
    last = run.estimates[-1]
    result = run.result()
    settings = run.inputs.settings
    seconds = (last.t_ns - run.estimates[0].t_ns) * 1e-9
    lines = [
        f"{name}: {seconds:.1f} s, {len(run.estimates)} ticks",
        f"structure {settings.structure}, estimator {settings.estimator}",
        f"state at the end: {last.state}{f' ({last.reason})' if last.reason else ''}",
    ]
    for stream, topic, msgtype in streams(run.inputs):
        refusals = run.refusals(stream)
        dropped = "".join(f", {count} {reason}" for reason, count in refusals.dropped.items())
        lines.append(f"{stream}: {topic} ({msgtype}), {refusals.received} messages{dropped}")
    if settings.actuators.estimate_delay:
        sigma = _sigma(run.identifier.delay_sigma)
        lines.append(f"estimated delay of the inputs: {run.identifier.delay:.3f} s, sigma {sigma}")
    if settings.airspeed.type:
        lines.append(f"coefficients at the reference airspeed, {settings.airspeed.reference:g} m/s")
    lines += ["", f"{'coefficient':<12}{'value':>12}{'sigma':>12}"]
    for coefficient, index in zip(run.structure.names, run.structure.free, strict=True):
        value, sigma = result.values[index], result.sigma[index]
        lines.append(f"{coefficient:<12}{value:>+12.4g}{_sigma(sigma):>12}")
    for windows, fit in fits.items():
        lines += ["", *_fit_lines(_TITLES[windows], fit)]
    return "\n".join(lines)


def _sigma(sigma: float) -> str:
    if sigma == 0.0:
        return "fixed"
    return f"{sigma:.2g}" if math.isfinite(sigma) else "unknown"


def _fit_lines(title: str, fit: PredictionFit) -> list[str]:
    header = f"1-second prediction fit {title} [%]"
    if not fit.windows:
        return [f"{header}: no window to score"]
    rows = [("identified model", fit.model)]
    if np.isfinite(fit.held_force).any():
        rows.append(("  with ay, az held", fit.held_force))
    rows.append(("holding the rates", fit.hold))
    lines = [f"{header}, {fit.windows} windows", f"{'':<20}" + "".join(f"{a:>9}" for a in AXES)]
    return lines + [f"{row:<20}" + "".join(f"{v:>9.1f}" for v in values) for row, values in rows]
