# SPDX-License-Identifier: Apache-2.0
"""The strip under the coefficients: state, usability, and which inputs moved."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.identification.supervision import State
from uav_ident_ros.report.activity import activity
from uav_ident_ros.report.drawing import color, tidy
from uav_ident_ros.report.flight import Flight

STATES = tuple(state.value for state in State)
"""State words; a colour of the style sheet has the name of each."""

ROWS = ("state", "usable", *INPUTS)
"""Rows of the strip, from above."""

HEIGHT_OF_ROW = 0.13
"""Inches."""

GRAVEST = ("fault", "waiting", "paused", "learning", "converged")
"""Where several states share a bin, the first of these is shown."""


def draw_strip(panel: Any, flight: Flight, bins: int, *, labels: bool) -> None:
    """Draw the strip over the whole flight.

    Parameters
    ----------
    panel : Axes
        Where to.
    flight : Flight
        The flight.
    bins : int
        How finely time is resolved.
    labels : bool
        Whether to name the rows.
    """
    first, last = flight.span
    edges = np.linspace(first, last, bins + 1)
    tick_bin = np.clip(np.searchsorted(edges, flight.tick_t, side="right") - 1, 0, bins - 1)
    words = _states(flight, tick_bin, bins)
    for word in STATES:
        _bars(panel, edges, [w == word for w in words], 0, color(word))
    usable = np.zeros(bins, dtype=bool)
    usable[tick_bin[flight.usable]] = True
    _bars(panel, edges, usable.tolist(), 1, color("tick"))
    moved = activity(flight.t, flight.u, 0.5 * (edges[:-1] + edges[1:]))
    peak = moved.max(axis=0)
    for i, share in enumerate((moved / np.where(peak > 0.0, peak, 1.0)).T):
        bottom = float(len(ROWS) - 3 - i)
        panel.fill_between(
            0.5 * (edges[:-1] + edges[1:]),
            bottom,
            bottom + 0.9 * share,
            color=color("measured"),
            linewidth=0.0,
        )
    _label(panel, flight, labels)


def _states(flight: Flight, tick_bin: FloatArray, bins: int) -> list[str]:
    """Return the gravest state of every bin; empty where there was no tick."""
    words = [""] * bins
    for k, estimate in zip(tick_bin, flight.estimates, strict=True):
        if not words[k] or GRAVEST.index(estimate.state) < GRAVEST.index(words[k]):
            words[k] = estimate.state
    return words


def _bars(panel: Any, edges: FloatArray, on: list[bool], row: int, shade: str) -> None:
    """Fill a row of the strip where it is on."""
    flips = [k for k, (a, b) in enumerate(pairwise([False, *on, False])) if a != b]
    runs = zip(flips[::2], flips[1::2], strict=True)
    spans = [(float(edges[a]), float(edges[b] - edges[a])) for a, b in runs]
    bottom = float(len(ROWS) - 1 - row)
    if spans:
        panel.broken_barh(spans, (bottom, 0.9), facecolor=shade, linewidth=0.0)


def _label(panel: Any, flight: Flight, labels: bool) -> None:
    tidy(panel)
    panel.grid(False)
    panel.spines["left"].set_visible(False)
    panel.set_xlim(*flight.span)
    panel.set_ylim(0.0, float(len(ROWS)))
    panel.set_yticks([len(ROWS) - 0.55 - k for k in range(len(ROWS))], ROWS if labels else [])
    panel.tick_params(axis="y", labelsize="small")
    panel.set_xlabel("time [s]")
