# SPDX-License-Identifier: Apache-2.0
"""Whether the inputs say anything new: the gate that pauses a row in quiet flight.

In quiet flight the autopilot's surfaces answer the gusts, and an estimator that goes on
learning learns the autopilot. Forgetting by direction does not help, pausing the row does.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import INPUT_COLUMNS, BoolArray, FloatArray

WINDOW_TIME = 3.0
"""Time over which the variance of an input is taken, s: a slow multisine still moves in it."""

QUIET_SHARE = 0.25
"""Share of its mean variance while learning below which an input is quiet: half the
amplitude. Relative to the largest variance instead, one wild manoeuvre would close the gate
for the rest of an ordinary flight."""


class ExcitationGate:
    """Tells which rows see excitation.

    Parameters
    ----------
    free : (3, n) bool array
        Coefficients that move; a row watches the inputs that it has a coefficient for.

    Attributes
    ----------
    share : (4,) array
        Variance of each input over the window, relative to its mean while learning.
    """

    def __init__(self, free: BoolArray) -> None:
        self._watched: BoolArray = free[:, INPUT_COLUMNS]
        self._window: deque[tuple[float, FloatArray, FloatArray]] = deque()
        self._time = 0.0
        self._sum: FloatArray = np.zeros(4)
        self._square: FloatArray = np.zeros(4)
        self._usual: FloatArray = np.zeros(4)
        self._usual_time: FloatArray = np.zeros(4)
        self.share: FloatArray = np.zeros(4)

    def update(self, data: Regression) -> BoolArray:
        """Return which rows may learn from the samples of this tick, shape (3,)."""
        variance = self._variance(data)
        self.share = np.divide(variance, self._usual, out=np.ones(4), where=self._usual > 0.0)
        lively = self._watched & (self.share >= QUIET_SHARE)
        learning: BoolArray = lively.any(axis=1) | ~self._watched.any(axis=1)
        heard = (self._watched & learning[:, None]).any(axis=0)
        spent = np.where(heard, data.dt * len(data.y), 0.0)
        self._usual_time += spent
        self._usual += spent / np.maximum(self._usual_time, data.dt) * (variance - self._usual)
        return learning

    def _variance(self, data: Regression) -> FloatArray:
        """Variance of the inputs over the window that ends with this tick, shape (4,)."""
        u = data.f[:, INPUT_COLUMNS]
        entry = (data.dt * len(u), data.dt * u.sum(axis=0), data.dt * (u * u).sum(axis=0))
        self._window.append(entry)
        self._time += entry[0]
        self._sum += entry[1]
        self._square += entry[2]
        while self._time > WINDOW_TIME and len(self._window) > 1:
            time, total, square = self._window.popleft()
            self._time -= time
            self._sum -= total
            self._square -= square
        mean = self._sum / self._time
        return np.maximum(self._square / self._time - mean * mean, 0.0)
