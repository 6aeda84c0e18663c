# SPDX-License-Identifier: Apache-2.0
"""What the flight covered: pairs of signals that should move independently, and correlations."""

from __future__ import annotations

from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, SPECIFIC_FORCES, FloatArray
from uav_ident_ros.report.drawing import NARROW, Draw, Format, color, tidy, title
from uav_ident_ros.report.flight import AXES, Flight
from uav_ident_ros.report.layout import panels

PAIRS = (("da", "dr"), ("de", "dth"), ("p", "r"), ("q", "p"))
"""Signals across and up of each chart."""

CELLS = 36
"""Cells of a chart along each axis."""

SHARE = (0.1, 99.9)
"""Percentiles of a signal that its axis spans."""

HEIGHT = {"wide": 2.4, "narrow": 4.3}
"""Inches."""

SIGNALS = (*INPUTS, *AXES, *SPECIFIC_FORCES)
"""Signals of a flight, in the order of `signals`."""


def signals(flight: Flight) -> FloatArray:
    """Return inputs, rates and specific forces at the gyro samples, shape (N, 9)."""
    return np.concatenate([flight.u, flight.rates, flight.force], axis=1)


def correlations(flight: Flight) -> FloatArray:
    """Return the correlations of the inputs with all signals, (4, 9); NaN where one is still."""
    values = signals(flight)
    deviation = values - values.mean(axis=0)
    size = np.linalg.norm(deviation, axis=0)
    size[size == 0.0] = np.nan
    scaled = deviation / size
    return np.asarray(scaled[:, : len(INPUTS)].T @ scaled)


def coverage_chart(flight: Flight) -> Draw:
    """Return what draws how often pairs of signals had which values."""
    values = dict(zip(SIGNALS, signals(flight).T, strict=True))

    def draw(figure: Any, form: Format) -> None:
        across = 2 if form is NARROW else len(PAIRS)
        grid = panels(figure, len(PAIRS) // across, across, gap_y=0.62)
        for k, (x, y) in enumerate(PAIRS):
            panel = figure.add_subplot(grid[k // across, k % across])
            _density(panel, values[x], values[y])
            tidy(panel)
            panel.set_xlabel(x, labelpad=1)
            title(panel, f"{y} over {x}")
            panel.locator_params(nbins=4)

    return draw


def _density(panel: Any, x: FloatArray, y: FloatArray) -> None:
    """Show how many samples fell into each cell, on a logarithmic scale."""
    spans = [_span(x), _span(y)]
    count, _, _ = np.histogram2d(x, y, bins=CELLS, range=spans)
    depth = np.log1p(count.T) / np.log1p(max(count.max(), 1.0))
    shade = color("tick").removeprefix("#")
    image = np.empty((CELLS, CELLS, 4), dtype=np.uint8)
    image[..., :3] = [int(shade[k : k + 2], 16) for k in (0, 2, 4)]
    image[..., 3] = np.round(255.0 * depth)
    extent = (*spans[0], *spans[1])
    panel.imshow(image, extent=extent, origin="lower", aspect="auto", interpolation="none")


def _span(values: FloatArray) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(values, SHARE))
    room = 0.05 * (high - low) or 1.0
    return low - room, high + room
