# SPDX-License-Identifier: Apache-2.0
"""Chart: how well every delay of the inputs explains the flight."""

from __future__ import annotations

from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.report.drawing import Draw, Format, color, legend, tidy
from uav_ident_ros.report.flight import AXES
from uav_ident_ros.report.layout import panels

HEIGHT = 2.7
"""Inches."""

LARGEST_RISE = 200.0
"""Largest residual shown, percent above the least: it is the bottom of the valley that counts."""

SHADES = ("tick", "third", "fourth")
DASHES = ("-", "--", "-.")
"""Colours and dashes of the rows pdot, qdot, rdot."""


SMALLEST_RISE = 0.01
"""Rise, percent, below which all delays explain the flight alike: the inputs hardly moved."""


def tells_delays_apart(residual: FloatArray) -> bool:
    """Whether there is a curve to draw; `residual` as in `delay_rise`, or empty."""
    if not len(residual) or not (residual > 0.0).all():
        return False
    return bool(delay_rise(residual)[0].max() > SMALLEST_RISE)


def delay_rise(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Say by how many percent, root mean square, residuals are above the least.

    Parameters
    ----------
    residual : (J, 3) array
        Residual sums of squares of pdot, qdot, rdot at J delays, positive.

    Returns
    -------
    rows : (J, 3) array
        Of each row.
    together : (J,) array
        Of all rows, by their geometric mean: what the estimate of the delay goes by.
    """
    root = np.sqrt(residual)
    mean = np.exp(np.log(root).mean(axis=1))
    return 100.0 * (root / root.min(axis=0) - 1.0), 100.0 * (mean / mean.min() - 1.0)


def delay_chart(delays: FloatArray, residual: FloatArray, in_use: float) -> Draw:
    """Return what draws the curve.

    Parameters
    ----------
    delays : (J,) array
        Delays tried, s.
    residual : (J, 3) array
        Residual sums of squares of pdot, qdot, rdot with them, positive.
    in_use : float
        Delay that the identifier ended with, s.
    """
    rows, together = delay_rise(residual)

    def draw(figure: Any, form: Format) -> None:
        panel = figure.add_subplot(panels(figure, 1, 1)[0, 0])
        tidy(panel)
        milliseconds = 1e3 * delays
        lines = zip(AXES, rows.T, SHADES, DASHES, strict=True)
        for axis, rise, shade, dashes in lines:
            panel.plot(milliseconds, rise, color=color(shade), linestyle=dashes, label=axis)
        panel.plot(milliseconds, together, color=color("ink"), linewidth=2.0, label="all three")
        panel.axvline(
            1e3 * in_use, color=color("ahead"), linewidth=1.6, linestyle=":", label="in use"
        )
        legend(panel)
        panel.set_xlim(0.0, float(milliseconds[-1]))
        panel.set_ylim(0.0, min(1.05 * float(rows.max()), LARGEST_RISE))
        panel.set_xlabel("delay [ms]")
        panel.set_ylabel("residual above its least [%]")

    return draw
