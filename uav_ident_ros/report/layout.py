# SPDX-License-Identifier: Apache-2.0
"""Where the panels of a chart stand, in inches: the same in every chart, without trial drawing."""

from __future__ import annotations

from typing import Any

LEFT, RIGHT = 0.62, 0.1
"""Margins beside the outermost panels: room for the labels of the left axis."""

TOP, BOTTOM = 0.3, 0.45
"""Margins above and below: room for a heading and for the label of the time axis."""

GAP_X, GAP_Y = 0.62, 0.34
"""Between panels that have headings and labels of their own."""


def panels(
    figure: Any,
    rows: int,
    columns: int,
    *,
    heights: tuple[float, ...] | None = None,
    widths: tuple[float, ...] | None = None,
    gap_x: float = GAP_X,
    gap_y: float = GAP_Y,
) -> Any:
    """Divide a figure into a grid.

    Parameters
    ----------
    figure : Figure
        The matplotlib figure.
    rows, columns : int
        Size of the grid.
    heights, widths : tuple of float, optional
        Relative sizes; equal if left out.
    gap_x, gap_y : float
        Between the panels, inches.

    Returns
    -------
    GridSpec
        To be indexed by row and column.
    """
    width, height = figure.get_size_inches()
    panel_width = (width - LEFT - RIGHT - gap_x * (columns - 1)) / columns
    panel_height = (height - TOP - BOTTOM - gap_y * (rows - 1)) / rows
    return figure.add_gridspec(
        rows,
        columns,
        height_ratios=heights,
        width_ratios=widths,
        left=LEFT / width,
        right=1.0 - RIGHT / width,
        top=1.0 - TOP / height,
        bottom=BOTTOM / height,
        wspace=gap_x / panel_width,
        hspace=gap_y / panel_height,
    )
