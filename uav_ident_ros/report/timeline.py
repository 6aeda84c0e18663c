# SPDX-License-Identifier: Apache-2.0
"""Charts over time with Bokeh, with a common range and crosshair."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh import models
from bokeh.plotting import figure

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.report.style import COLORS

WITH_BUTTONS = 200
"""Height from which a chart has buttons, pixels; lower ones move with it."""

AXIS_MARGIN = 0.08
"""Margin beyond the values on an axis, relative to their range."""


@dataclass(frozen=True)
class Chart:
    """A chart on the page; its template has the explanations."""

    identity: str  # Unique on the page
    heading: str  # Heading above the chart
    model: Any  # The Bokeh figure
    legend: tuple[tuple[str, str], ...] = ()  # Names and their colours
    small: bool = False  # Whether several charts stand side by side


def columns(values: Mapping[str, Any]) -> models.ColumnDataSource:
    """Return a data source in single precision, which halves the size of the page."""
    return models.ColumnDataSource(
        {name: np.asarray(column, dtype=np.float32) for name, column in values.items()}
    )


def value_range(*values: FloatArray) -> models.Range1d:
    """Return a range that holds all finite values."""
    every = np.concatenate([np.ravel(v) for v in values])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 0.0)
    room = max(AXIS_MARGIN * (high - low), 1e-9)
    return models.Range1d(low - room, high + room)


def plain_figure(height: int, along: str | None, unit: str, **options: Any) -> Any:
    """Return an empty figure with the labels of its axes; the page's theme has its style."""
    result = figure(height=height, title=None, tools="", **options)
    result.xaxis.axis_label, result.yaxis.axis_label = along, unit
    if isinstance(result.y_range, models.Range1d):
        result.yaxis.ticker.desired_num_ticks = 4
    return result


def hover(chart: Any, drawn: Any, *tips: tuple[str, str], mode: str = "mouse") -> None:
    """Add tooltips to a drawn object: pairs of a label and a field."""
    chart.add_tools(models.HoverTool(renderers=[drawn], mode=mode, tooltips=[*tips], visible=False))


class Timeline:
    """Makes charts that share their time axis."""

    def __init__(
        self,
        span: tuple[float, float],  # First and last time, s
        restarts: Sequence[float],  # Times at which a new time base begins, s
    ) -> None:
        self.span = span
        self._restarts = restarts
        self._range = models.Range1d(*span, bounds=span)
        self._cross = models.Span(
            dimension="height", line_color=COLORS["muted"], line_dash="dashed", line_width=1
        )

    def figure(self, unit: str, height: int, **options: Any) -> Any:
        """Return an empty chart over time that pans and zooms with all others."""
        result = plain_figure(height, "time [s]", unit, x_range=self._range, **options)
        pan, wheel = models.PanTool(dimensions="width"), models.WheelZoomTool(dimensions="width")
        wheel.modifiers = {"ctrl": True}  # the bare wheel scrolls the page
        result.add_tools(pan, wheel, models.CrosshairTool(overlay=self._cross))
        result.toolbar.active_drag, result.toolbar.active_scroll = pan, wheel
        if height < WITH_BUTTONS:
            result.toolbar_location = None
        else:
            result.add_tools(models.BoxZoomTool(), models.ResetTool(), models.SaveTool())
        result.min_border_right = 12
        for restart in self._restarts:
            result.add_layout(
                models.Span(dimension="height", location=restart, line_dash="dotted", line_width=1)
            )
        return result

    def source(
        self,
        t: FloatArray,  # (k,) Times, s, rising
        signals: Mapping[str, FloatArray],  # Names and values, (k,) each
        bins: tuple[float, int],  # Bins per second, and at most
    ) -> models.ColumnDataSource:
        """Return a data source of signals, thinned without losing a peak."""
        per_second, most = bins
        return columns(thin(t, signals, min(most, max(1, round(per_second * self.span[1])))))

    def line(
        self, chart: Any, source: models.ColumnDataSource, column: str, color: str, **options: Any
    ) -> tuple[str, str]:
        """Draw a column of a source over its column ``t``; return its entry in a legend.

        The colour is a name in `COLORS`.
        """
        name = str(options.pop("name", column))
        drawn = chart.line("t", column, source=source, name=name, color=COLORS[color], **options)
        tips = (("time", "@t{0.00} s"), (name, f"@{{{column}}}{{0.0000}}"))
        hover(chart, drawn, *tips, mode="vline")
        return name, color


LONGEST_GAP = 0.5
"""Time without samples from which a line is interrupted, s."""


def thin(
    t: FloatArray,  # (k,) Times, s, rising
    columns: Mapping[str, FloatArray],  # Names and values, (k,) each
    bins: int,  # Number of bins; up to twice as many samples are not thinned
) -> dict[str, FloatArray]:
    """Return the smallest and the largest value of every column in every bin of time.

    The result has ``t`` and the columns, of one length, with NaN between two pieces.
    """
    values = np.stack([np.asarray(column, dtype=float) for column in columns.values()], axis=1)
    gaps = np.flatnonzero(np.diff(t) > LONGEST_GAP) + 1  # the first samples after them
    if len(t) > 2 * bins:
        place = ((t - t[0]) * (bins / (t[-1] - t[0]))).astype(int).clip(max=bins - 1)
        starts = np.union1d(np.flatnonzero(np.diff(place, prepend=-1)), gaps)
        ends = np.append(starts[1:], len(t)) - 1
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        # the order of the two keeps the slope of the line
        rises = values[ends] >= values[starts]
        pairs = np.stack([np.where(rises, low, high), np.where(rises, high, low)], axis=1)
        gaps = 2 * np.searchsorted(starts, gaps)
        t = np.stack([t[starts], t[ends]], axis=1).ravel()
        values = pairs.reshape(len(t), -1)
    t, values = np.insert(t, gaps, t[gaps]), np.insert(values, gaps, np.nan, axis=0)
    return {"t": t, **dict(zip(columns, values.T, strict=True))}
