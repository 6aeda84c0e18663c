# SPDX-License-Identifier: Apache-2.0
"""Lines of many samples, thinned so that no peak is lost."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

LONGEST_GAP = 0.5
"""Time without samples from which a line is broken, s."""


def thin(
    t: FloatArray,  # (k,) Times, s, rising
    columns: Mapping[str, FloatArray],  # Names and values, (k,) each
    bins: int,  # Bins over the whole time; no more than twice as many samples stay as they are
    gap: float = LONGEST_GAP,  # Time without samples from which the lines are broken, s
) -> dict[str, FloatArray]:
    """Keep the smallest and the largest value of every column in every bin of time.

    Returns
    -------
    dict
        ``t`` and the columns, of one length; NaN between two pieces.
    """
    values = np.stack([np.asarray(column, dtype=float) for column in columns.values()], axis=1)
    parts: list[tuple[FloatArray, FloatArray]] = []
    if len(t):
        cuts = np.flatnonzero(np.diff(t) > gap) + 1
        span = max(float(t[-1] - t[0]), 1e-9)
        for piece_t, piece in zip(np.split(t, cuts), np.split(values, cuts), strict=True):
            share = (piece_t[-1] - piece_t[0]) / span
            if parts:
                parts.append((piece_t[:1], np.full((1, values.shape[1]), np.nan)))
            parts.append(_thin(piece_t, piece, max(1, round(bins * share))))
    t, values = (
        (np.concatenate([part[k] for part in parts]) for k in (0, 1)) if parts else (t, values)
    )
    return {"t": t, **dict(zip(columns, values.T, strict=True))}


def _thin(t: FloatArray, y: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    """Thin a piece without gaps: times (m,) and values (m, c) from (k,) and (k, c)."""
    if len(t) <= 2 * bins:
        return t, y
    position = (t - t[0]) * (bins / (t[-1] - t[0]))
    starts = np.searchsorted(position, np.arange(bins))
    starts = starts[np.diff(starts, append=len(t)) > 0]
    ends = np.append(starts[1:], len(t)) - 1
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    # In the order in which the line runs, so that a slope stays a slope.
    rises = y[ends] >= y[starts]
    first, second = np.where(rises, low, high), np.where(rises, high, low)
    times = np.stack([t[starts], t[ends]], axis=1).ravel()
    return times, np.stack([first, second], axis=1).reshape(len(times), -1)
