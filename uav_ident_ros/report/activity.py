# SPDX-License-Identifier: Apache-2.0
"""When the inputs moved: their spread over a few seconds, along the flight."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.estimators.excitation import WINDOW_TIME
from uav_ident_ros.identification.structure import FloatArray


def activity(t: FloatArray, u: FloatArray, at: FloatArray) -> FloatArray:
    """Return the standard deviation of each input over the `WINDOW_TIME` around some times.

    Parameters
    ----------
    t : (N,) array
        Times of the samples, s, rising.
    u : (N, m) array
        Inputs.
    at : (k,) array
        Times asked for, s.

    Returns
    -------
    (k, m) array
        Standard deviations; zero where there are no samples.
    """
    first = np.searchsorted(t, at - 0.5 * WINDOW_TIME)
    end = np.searchsorted(t, at + 0.5 * WINDOW_TIME, side="right")
    count = np.maximum(end - first, 1)[:, None]
    centred = u - u.mean(axis=0)
    mean, square = (
        (sums[end] - sums[first]) / count for sums in map(_running_sum, (centred, centred**2))
    )
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)))


def _running_sum(values: FloatArray) -> FloatArray:
    """Sum the rows before each row, and all of them, shape (N + 1, m)."""
    sums = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=sums[1:])
    return sums
