# SPDX-License-Identifier: Apache-2.0
"""Chart: measured and predicted rates of an axis with residuals, over the flight and in detail."""

from __future__ import annotations

from typing import Any

import numpy as np

from uav_ident_ros.identification.prediction import LAST_PART
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.report.drawing import NARROW, Draw, Format, color, tidy, title
from uav_ident_ros.report.envelope import envelope
from uav_ident_ros.report.flight import AXES, Flight
from uav_ident_ros.report.layout import panels
from uav_ident_ros.report.predictions import Predictions

DETAIL_TIME = 12.0
"""Length of the detail, s: the shortest period of an excitation and the longest mode are in it."""

DETAIL_STEP = 1.0
"""The detail begins at a multiple of this, s."""

HEADROOM = 1.35
"""The axis of the rates reaches so far beyond what was measured: a wild prediction leaves it."""

RESIDUAL_SHARE = 99.5
"""Percentile of the residuals of the last 40 % of the flight that their axis reaches."""

SMALLEST_RANGE = 1e-3
"""Least half-range of an axis, rad/s."""

HEIGHT = {"wide": 3.4, "narrow": 6.6}
"""Inches."""


def detail_span(flight: Flight) -> tuple[float, float]:
    """Return begin and end, s, of the liveliest `DETAIL_TIME` of the last 40 % of the flight."""
    first, last = flight.span
    begin = last - LAST_PART * (last - first)
    begins = np.arange(begin, last - DETAIL_TIME, DETAIL_STEP)
    if not len(begins):
        return max(first, last - DETAIL_TIME), last
    spread = flight.rates.std(axis=0)
    scaled = flight.rates / np.where(spread > 0.0, spread, 1.0)
    energy = np.concatenate([[0.0], np.cumsum((scaled**2).sum(axis=1))])
    index = np.searchsorted(flight.t, np.stack([begins, begins + DETAIL_TIME]))
    best = float(begins[np.argmax(energy[index[1]] - energy[index[0]])])
    return best, best + DETAIL_TIME


def rates_chart(flight: Flight, axis: int, second: Predictions, tick: Predictions) -> Draw:
    """Return what draws the chart of an axis.

    Parameters
    ----------
    flight : Flight
        The flight.
    axis : int
        0, 1, 2 for p, q, r.
    second, tick : Predictions
        Predictions over one second and over one tick.
    """
    measured = flight.rates[:, axis]
    limit = HEADROOM * max(float(np.abs(measured).max(initial=0.0)), SMALLEST_RANGE)
    reach = max(_residual_reach(flight, prediction, axis) for prediction in (second, tick))
    reach = min(max(HEADROOM * reach, SMALLEST_RANGE), limit)

    def draw(figure: Any, form: Format) -> None:
        for k, span in enumerate((flight.span, detail_span(flight))):
            upper, lower = _pair(figure, form, k)
            bins = form.bins if form is NARROW else round(form.bins * (0.62, 0.38)[k])
            _line(upper, flight.t, measured, span, bins, "measured", width=1.3 + k)
            for prediction, shade in ((second, "ahead"), (tick, "tick")):
                dashes = "--" if prediction is tick else "-"
                if k == 1 or prediction is second:
                    y = prediction.predicted[:, axis]
                    _line(upper, prediction.t, y, span, bins, shade, style=dashes)
                y = prediction.residual[:, axis]
                _line(lower, prediction.t, y, span, bins, shade, width=0.8)
            upper.set_ylim(-limit, limit)
            lower.set_ylim(-reach, reach)
            detail = f"{span[0]:.0f} to {span[1]:.0f} s in detail"
            title(upper, detail if k else "whole flight")
            if k == 0 or form is NARROW:
                upper.set_ylabel(f"{AXES[axis]} [rad/s]")
                lower.set_ylabel("residual")
            _finish(flight, upper, lower, span)

    return draw


def _residual_reach(flight: Flight, prediction: Predictions, axis: int) -> float:
    first, last = flight.span
    settled = prediction.t >= last - LAST_PART * (last - first)
    residuals = np.abs(prediction.residual[settled, axis])
    return float(np.percentile(residuals, RESIDUAL_SHARE)) if len(residuals) else 0.0


def _pair(figure: Any, form: Format, k: int) -> tuple[Any, Any]:
    """Return the axes of rates and of residuals, of the flight (0) or of the detail (1)."""
    if form is NARROW:
        grid = panels(figure, 5, 1, heights=(2.0, 1.0, 0.42, 2.0, 1.0), gap_y=0.14)
        upper, lower = figure.add_subplot(grid[3 * k, 0]), figure.add_subplot(grid[3 * k + 1, 0])
    else:
        grid = panels(figure, 2, 2, heights=(2.0, 1.0), widths=(1.6, 1.0), gap_x=0.5, gap_y=0.14)
        upper, lower = figure.add_subplot(grid[0, k]), figure.add_subplot(grid[1, k])
    return upper, lower


def _line(
    panel: Any,
    t: FloatArray,
    y: FloatArray,
    span: tuple[float, float],
    bins: int,
    shade: str,
    width: float = 1.0,
    style: str = "-",
) -> None:
    """Draw what lies in a span."""
    first, end = np.searchsorted(t, span)
    thin_t, thin_y = envelope(t[first:end], y[first:end], bins)
    panel.plot(thin_t, thin_y, color=color(shade), linewidth=width, linestyle=style)


def _finish(flight: Flight, upper: Any, lower: Any, span: tuple[float, float]) -> None:
    for panel in (upper, lower):
        tidy(panel)
        panel.set_xlim(*span)
        for restart in flight.clock.restarts:
            panel.axvline(restart, color=color("ink"), linewidth=0.8, linestyle=":")
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("time [s]")
