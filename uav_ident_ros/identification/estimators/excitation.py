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

LOOK_TIME = 0.25
"""Time between two looks at the window, s."""


class ExcitationGate:
    """Tells which rows see excitation.

    Parameters
    ----------
    free : (3, n) bool array
        Coefficients that move; a row watches the inputs that it has a coefficient for.
    min_share : float
        Share of its mean variance while learning below which an input is quiet. Relative to
        the largest variance instead, one wild manoeuvre would close the gate for the rest of
        an ordinary flight.

    Attributes
    ----------
    min_share : float
        The parameter; it may change at any time.
    share : (4,) array
        Variance of each input over the window, relative to its mean while learning.
    learning : (3,) bool array
        Rows that see excitation.
    quiet : (n,) bool array
        Regressors that are inputs and say nothing at present.
    """

    def __init__(self, free: BoolArray, min_share: float) -> None:
        self.min_share = min_share
        self._watched: BoolArray = free[:, INPUT_COLUMNS]
        self._window: deque[tuple[float, FloatArray]] = deque()
        self._window_time = 0.0
        self._since_look = 0.0
        self._usual: FloatArray = np.zeros(4)
        self._usual_time: FloatArray = np.zeros(4)
        self.share: FloatArray = np.zeros(4)
        self.learning: BoolArray = np.ones(3, dtype=bool)
        self.quiet: BoolArray = np.zeros(free.shape[1], dtype=bool)

    def update(self, data: Regression) -> BoolArray:
        """Return which rows may learn from the samples of this tick, shape (3,)."""
        u = data.f[:, INPUT_COLUMNS]
        dt = data.dt * len(u)
        sums = data.dt * np.concatenate([np.add.reduce(u), np.add.reduce(u * u)])
        self._window.append((dt, sums))
        self._since_look += dt
        if self._since_look >= LOOK_TIME or len(self._window) == 1:
            self._look()
        return self.learning

    def _look(self) -> None:
        """Compare the inputs over the window with what is usual."""
        elapsed, self._since_look = self._since_look, 0.0
        self._window_time += elapsed
        while self._window_time > WINDOW_TIME and len(self._window) > 1:
            self._window_time -= self._window.popleft()[0]
        time = sum(entry[0] for entry in self._window)
        sums = np.concatenate([entry[1] for entry in self._window]).reshape(-1, 2, 4)
        total, square = np.add.reduce(sums)
        variance = np.maximum(square / time - (total / time) ** 2, 0.0)
        self.share = np.divide(variance, self._usual, out=np.ones(4), where=self._usual > 0.0)
        self.quiet[INPUT_COLUMNS] = self.share < self.min_share
        lively = self._watched & (self.share >= self.min_share)
        self.learning = lively.any(axis=1) | ~self._watched.any(axis=1)
        heard = (self._watched & self.learning[:, None]).any(axis=0)
        spent = np.where(heard, elapsed, 0.0)
        self._usual_time += spent
        self._usual += spent / np.maximum(self._usual_time, elapsed) * (variance - self._usual)
