# SPDX-License-Identifier: Apache-2.0
"""How much a row may learn: little in quiet flight.

In quiet flight the autopilot's surfaces answer the gusts, and an estimator that goes on
learning learns the autopilot. Forgetting by direction does not help, less weight to the whole row
does. A switch in the place of the weight starves the instruments where a flight tells little.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.scales import INDEPENDENT_TIME, LOOK_TIME, RESPONSE_TIME, TINY
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import INPUT_COLUMNS, BoolArray, FloatArray

WINDOW_TIME = RESPONSE_TIME + INDEPENDENT_TIME
"""Time over which the variance of an input is taken, s: residuals of `INDEPENDENT_TIME` have the
answers to what it did in this, and a slow multisine still moves in it."""


class ExcitationGate:
    """Tells how much excitation the rows see.

    A row learns while at least one of its inputs is lively; the less lively, the less it counts.
    """

    def __init__(
        self,
        free: BoolArray,  # (3, n) Coefficients that move: their inputs are watched
        settings: SupervisionSettings,  # They may change at any time
    ) -> None:
        self.settings = settings
        self._watched: BoolArray = free[:, INPUT_COLUMNS]
        self._blind: BoolArray = ~self._watched.any(axis=1)
        # of each update: time, and the integrals of u, u^2 and the squared residuals
        self._window: deque[FloatArray] = deque()
        self._window_time = 0.0
        self._since_look = 0.0
        self._usual: FloatArray = np.zeros(4)
        self._usual_time: FloatArray = np.zeros(4)
        # Variance of each input over the window, relative to its mean while learning. Relative to
        # the largest one, one wild manoeuvre would close the gate for an ordinary flight.
        self.share: FloatArray = np.zeros(4)
        # Variance that the inputs explain in each row, relative to that of the residual
        self.signal: FloatArray = np.zeros(3)
        self.weight: FloatArray = np.ones(3)  # How much each row learns, 0 ... 1
        self.learning: BoolArray = np.ones(3, dtype=bool)  # Rows that learn in full
        # Those of them in which the inputs explain more than all else together. In a storm an
        # autopilot's answers look like a change, and large residuals are no reason to learn.
        self.clear: BoolArray = np.ones(3, dtype=bool)

    def update(
        self,
        samples: Regression,
        residual: FloatArray,  # (m, 3) Theirs, rad/s^2
        coefficients: FloatArray,  # (3, n) What is known
    ) -> FloatArray:
        """Return how much the rows may learn from samples, shape (3,)."""
        u = samples.f[:, INPUT_COLUMNS]
        signals = np.concatenate((np.ones((len(u), 1)), u, u * u, residual * residual), axis=1)
        self._window.append(samples.dt * np.add.reduce(signals))
        self._since_look += samples.time
        if self._since_look >= LOOK_TIME - 0.5 * samples.dt or len(self._window) == 1:
            self._look(coefficients[:, INPUT_COLUMNS])
        return self.weight

    def _look(self, effect: FloatArray) -> None:
        """Compare the inputs over the window with what is usual, and with the residuals."""
        elapsed, self._since_look = self._since_look, 0.0
        self._window_time += elapsed
        while self._window_time > WINDOW_TIME and len(self._window) > 1:
            self._window_time -= self._window.popleft()[0]
        sums = np.add.accumulate(np.array(self._window)[::-1])
        means = sums[-1] / sums[-1, 0]
        # The residuals over the newest part: a gust front shows at once.
        newest = sums[sums[:-1, 0].searchsorted(INDEPENDENT_TIME)]
        variance = np.maximum(means[5:9] - means[1:5] ** 2, 0.0)
        self.share = np.divide(variance, self._usual, out=np.ones(4), where=self._usual > 0.0)
        residual = np.maximum(newest[9:] / newest[0], TINY)
        self.signal = (self._watched * effect**2) @ variance / residual
        enough = max(self.settings.min_excitation, TINY)
        liveliest = np.maximum.reduce(self._watched * self.share, axis=1) / enough
        liveliest[self._blind] = 1.0
        # The square: what the samples tell falls as the variance of the inputs, and what
        # feedback tells instead does not.
        self.weight = np.minimum(liveliest, 1.0) ** 2
        self.learning = self.weight == 1.0
        self.clear = self.learning & (self.signal >= 1.0)
        counted = np.logical_or.reduce(self._watched & self.learning[:, None])
        spent = elapsed * counted
        self._usual_time += spent
        self._usual += spent / np.maximum(self._usual_time, elapsed) * (variance - self._usual)
