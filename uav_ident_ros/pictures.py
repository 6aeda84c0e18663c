# SPDX-License-Identifier: Apache-2.0
"""Pictures of a flight's identification, with matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import ROWS, FloatArray, Structure

SIZE = (13.0, 8.0)
"""Inches."""

DPI = 110

LINEAR_BELOW = 1.0
"""Coefficients below this, in SI, are drawn on a linear scale, above on a logarithmic one."""

HEADROOM = 1.5
"""The rates' axes reach so far beyond the measured rates: a divergent prediction leaves them."""

AXES = "pqr"


class PictureError(Exception):
    """A picture cannot be made; the message says why."""


def save_overview(
    path: Path | str,
    *,
    t: FloatArray,
    measured: FloatArray,
    predicted: FloatArray,
    coefficients: FloatArray,
    structure: Structure,
    title: str,
    notes: tuple[str, str, str] = ("", "", ""),
) -> None:
    """Draw measured against predicted rates, and the coefficients over time, as a PNG.

    Parameters
    ----------
    path : Path or str
        The file.
    t : (K,) array
        Times of the ticks, s.
    measured, predicted : (K, 3) array
        Measured rates and those of the identified model at the ticks, rad/s, same axes.
    coefficients : (K, 3, n) array
        Coefficients at the ticks, SI.
    structure : Structure
        Their structure.
    title : str
        Heading.
    notes : tuple of 3 str
        Heading of the picture of each axis, such as its fit.

    Raises
    ------
    PictureError
        If matplotlib is missing or the file cannot be written.
    """
    figure = _figure()
    panels = figure.subplots(3, 2, sharex=True, width_ratios=(1.25, 1.0))
    for axis in range(3):
        _draw_rates(panels[axis][0], axis, t, measured[:, axis], predicted[:, axis], notes[axis])
        _draw_coefficients(panels[axis][1], axis, t, coefficients[:, axis], structure)
    panels[0][0].legend(loc="upper right", ncols=2, fontsize="small")
    for panel in panels[2]:
        panel.set_xlabel("time [s]")
    figure.suptitle(title)
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


def _draw_rates(
    panel: Any, axis: int, t: FloatArray, measured: FloatArray, predicted: FloatArray, note: str
) -> None:
    name = AXES[axis]
    panel.plot(t, measured, color="0.35", linewidth=1.0, label="measured")
    panel.plot(t, predicted, color="tab:red", linewidth=0.9, label="identified model")
    limit = HEADROOM * max(float(np.abs(measured).max(initial=0.0)), 1e-3)
    panel.set_ylim(-limit, limit)
    panel.set_ylabel(f"{name} [rad/s]")
    if note:
        panel.set_title(f"{name}: {note}", fontsize="medium", loc="left")
    panel.grid(alpha=0.3)


def _draw_coefficients(
    panel: Any, row: int, t: FloatArray, coefficients: FloatArray, structure: Structure
) -> None:
    for i, j in structure.free:
        if i == row:
            panel.plot(t, coefficients[:, j], linewidth=1.1, label=structure.regressors[j])
    panel.set_yscale("symlog", linthresh=LINEAR_BELOW)
    panel.set_ylabel(f"coefficients of {ROWS[row]} [SI]")
    panel.grid(alpha=0.3)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
