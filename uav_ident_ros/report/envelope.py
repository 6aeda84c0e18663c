# SPDX-License-Identifier: Apache-2.0
"""Lines of many samples, thinned so that no peak is lost."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

LONGEST_GAP = 0.5
"""Time without samples from which a line is broken, s."""


def envelope(
    t: FloatArray, y: FloatArray, bins: int, gap: float = LONGEST_GAP
) -> tuple[FloatArray, FloatArray]:
    """Keep the smallest and the largest value of every bin of time.

    Parameters
    ----------
    t : (k,) array
        Times, s, rising.
    y : (k,) array
        Values.
    bins : int
        Bins over the whole time; a line of no more than twice as many samples stays as it is.
    gap : float
        Time without samples from which the line is broken, s.

    Returns
    -------
    t, y : (m,) arrays
        The thinned line, with NaN between two pieces.
    """
    if not len(t):
        return t, y
    pieces_t: list[FloatArray] = []
    pieces_y: list[FloatArray] = []
    cuts = np.flatnonzero(np.diff(t) > gap) + 1
    span = max(float(t[-1] - t[0]), 1e-9)
    for piece_t, piece_y in zip(np.split(t, cuts), np.split(y, cuts), strict=True):
        share = (piece_t[-1] - piece_t[0]) / span
        thin_t, thin_y = _thin(piece_t, piece_y, max(1, round(bins * share)))
        pieces_t += [thin_t, np.array([np.nan])]
        pieces_y += [thin_y, np.array([np.nan])]
    return np.concatenate(pieces_t[:-1]), np.concatenate(pieces_y[:-1])


def _thin(t: FloatArray, y: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    if len(t) <= 2 * bins:
        return t, y
    position = (t - t[0]) * (bins / (t[-1] - t[0]))
    starts = np.searchsorted(position, np.arange(bins))
    starts = starts[np.diff(starts, append=len(t)) > 0]
    ends = np.append(starts[1:], len(t)) - 1
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    # In the order in which the line runs, so that a slope stays a slope.
    rises = y[ends] >= y[starts]
    pairs = np.stack([np.where(rises, low, high), np.where(rises, high, low)], axis=1)
    times = np.stack([t[starts], t[ends]], axis=1)
    return times.ravel(), pairs.ravel()
