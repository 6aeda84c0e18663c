# SPDX-License-Identifier: Apache-2.0
"""Chart: every coefficient of a row over time with its sigma band, and the strip under them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    PRODUCT_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    FloatArray,
)
from uav_ident_ros.report.drawing import Draw, Format, color, tidy, title
from uav_ident_ros.report.flight import Flight
from uav_ident_ros.report.layout import BOTTOM, GAP_Y, TOP, panels
from uav_ident_ros.report.strip import HEIGHT_OF_ROW, draw_strip
from uav_ident_ros.report.strip import ROWS as STRIP_ROWS

PANEL_HEIGHT = 0.85
"""Height of the panel of one coefficient, inches."""

STRIP_HEIGHT = HEIGHT_OF_ROW * len(STRIP_ROWS)

POINTS = 140
"""Ticks drawn of a coefficient: it moves slowly."""

SETTLED_SHARE = 0.3
"""Share of the flight at its start that does not decide the range of an axis: the first estimates
jump about."""

BAND_SHARE = 95.0
"""Percentile of the band, after that, that the axis reaches."""

HEADROOM = 0.12
"""Room beyond that, relative to the range."""


def order(flight: Flight, row: int) -> list[int]:
    """Return the columns of a row as they are shown: damping and control first."""
    columns = [j for i, j in flight.structure.free if i == row]
    groups = (RATE_COLUMNS, INPUT_COLUMNS, slice(INPUT_COLUMNS.stop, None), PRODUCT_COLUMNS)
    n = flight.structure.size
    return [j for group in groups for j in columns if j in range(n)[group]]


def height(flight: Flight, row: int, form: Format) -> float:
    """Height of the chart, inches."""
    rows = math.ceil(len(order(flight, row)) / form.columns)
    return TOP + BOTTOM + rows * (PANEL_HEIGHT + GAP_Y) + STRIP_HEIGHT


def coefficients_chart(flight: Flight, row: int) -> Draw:
    """Return what draws the chart of a row: 0, 1, 2 for pdot, qdot, rdot."""
    columns = order(flight, row)
    kept = np.unique(np.linspace(0, len(flight.tick_t) - 1, POINTS).round().astype(int))
    t = flight.tick_t[kept]

    def draw(figure: Any, form: Format) -> None:
        across = form.columns
        rows = math.ceil(len(columns) / across)
        heights = (PANEL_HEIGHT,) * rows + (STRIP_HEIGHT,)
        grid = panels(figure, rows + 1, across, heights=heights, gap_x=0.6)
        for k, column in enumerate(columns):
            panel = figure.add_subplot(grid[k // across, k % across])
            value = flight.coefficients[kept, row, column]
            _coefficient(panel, t, value, flight.sigma[kept, row, column])
            title(panel, f"{ROWS[row]}/{flight.structure.regressors[column]}")
            panel.set_xlim(*flight.span)
            panel.tick_params(labelbottom=False)
        for k in range(across):
            draw_strip(figure.add_subplot(grid[rows, k]), flight, POINTS, labels=k == 0)

    return draw


def _coefficient(panel: Any, t: FloatArray, value: FloatArray, sigma: FloatArray) -> None:
    tidy(panel)
    low, high = value - sigma, value + sigma
    panel.fill_between(t, low, high, color=color("band"), linewidth=0.0)
    panel.axhline(0.0, color=color("muted"), linewidth=0.6)
    panel.plot(t, value, color=color("tick"), linewidth=1.2)
    settled = t >= t[0] + SETTLED_SHARE * (t[-1] - t[0])
    bottom = min(float(np.percentile(low[settled], 100.0 - BAND_SHARE)), 0.0)
    top = max(float(np.percentile(high[settled], BAND_SHARE)), 0.0)
    if bottom == top == 0.0:
        bottom, top = -1.0, 1.0
    room = HEADROOM * (top - bottom)
    panel.set_ylim(bottom - room, top + room)
    panel.locator_params(axis="y", nbins=4)
