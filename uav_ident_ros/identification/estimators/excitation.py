# SPDX-License-Identifier: Apache-2.0
"""Weight of the samples by excitation: little in quiet flight.

In quiet flight the autopilot's surfaces answer the gusts, and an estimator that goes on learning
identifies the autopilot. Forgetting by direction does not help; less weight of the whole row does.
A switch in the place of the weight starves the instruments on a flight with little excitation.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.scales import INDEPENDENT_TIME, LOOK_TIME, RESPONSE_TIME, TINY
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import INPUT_COLUMNS, BoolArray, FloatArray

WINDOW_TIME = RESPONSE_TIME + INDEPENDENT_TIME
"""Window of the input's variance, s: residuals of `INDEPENDENT_TIME` contain the response to the
inputs of this time, and a slow multisine still moves in it."""


class ExcitationGate:
    """Excitation of the rows, and the weight that follows.

    A row learns while at least one of its inputs is excited. Its weight falls with the excitation.
    """

    def __init__(
        self,
        free: BoolArray,  # (3, n) Coefficients that are estimated: their inputs count
        settings: SupervisionSettings,  # May change at any time
    ) -> None:
        self.settings = settings
        self._watched: BoolArray = free[:, INPUT_COLUMNS]
        self._blind: BoolArray = ~self._watched.any(axis=1)
        # Of each update: time, and the integrals of u, u^2 and the squared residuals
        self._window: deque[FloatArray] = deque()
        self._window_time = 0.0
        self._since_look = 0.0
        self._usual: FloatArray = np.zeros(4)
        self._usual_time: FloatArray = np.zeros(4)
        # Variance of each input over the window, relative to its baseline variance while learning.
        # Relative to the largest one, one wild manoeuvre would close the gate for an ordinary
        # flight.
        self.share: FloatArray = np.zeros(4)
        # Variance that the inputs explain in each row, relative to that of the residual
        self.signal: FloatArray = np.zeros(3)
        self.weight: FloatArray = np.ones(3)  # Weight of each row, 0 ... 1
        self.learning: BoolArray = np.ones(3, dtype=bool)  # Rows of full weight
        # Those of them in which the inputs explain more than all else together. In a storm an
        # autopilot's answers resemble a change, and large residuals are no reason to learn.
        self.clear: BoolArray = np.ones(3, dtype=bool)

    def update(
        self,
        samples: Regression,
        residual: FloatArray,  # (m, 3) Of the samples, rad/s^2
        coefficients: FloatArray,  # (3, n) The present estimate
    ) -> FloatArray:
        """Return the weight of samples in the rows, shape (3,)."""
        u = samples.f[:, INPUT_COLUMNS]
        signals = np.concatenate((np.ones((len(u), 1)), u, u * u, residual * residual), axis=1)
        self._window.append(samples.dt * np.add.reduce(signals))
        self._since_look += samples.time
        if self._since_look >= LOOK_TIME - 0.5 * samples.dt or len(self._window) == 1:
            self._look(coefficients[:, INPUT_COLUMNS])
        return self.weight

    def _look(self, effect: FloatArray) -> None:
        """Compare the inputs' variance with its baseline and with the residuals."""
        elapsed, self._since_look = self._since_look, 0.0
        self._window_time += elapsed
        while self._window_time > WINDOW_TIME and len(self._window) > 1:
            self._window_time -= self._window.popleft()[0]
        sums = np.add.accumulate(np.array(self._window)[::-1])
        means = sums[-1] / sums[-1, 0]
        # The residuals of the newest part only: a gust front then shows at once.
        newest = sums[sums[:-1, 0].searchsorted(INDEPENDENT_TIME)]
        variance = np.maximum(means[5:9] - means[1:5] ** 2, 0.0)
        self.share = np.divide(variance, self._usual, out=np.ones(4), where=self._usual > 0.0)
        residual = np.maximum(newest[9:] / newest[0], TINY)
        self.signal = (self._watched * effect**2) @ variance / residual
        enough = max(self.settings.min_excitation, TINY)
        liveliest = np.maximum.reduce(self._watched * self.share, axis=1) / enough
        liveliest[self._blind] = 1.0
        # The square: the samples' information falls as the inputs' variance, feedback's bias does
        # not.
        self.weight = np.minimum(liveliest, 1.0) ** 2
        self.learning = self.weight == 1.0
        self.clear = self.learning & (self.signal >= 1.0)
        counted = np.logical_or.reduce(self._watched & self.learning[:, None])
        spent = elapsed * counted
        self._usual_time += spent
        self._usual += spent / np.maximum(self._usual_time, elapsed) * (variance - self._usual)
