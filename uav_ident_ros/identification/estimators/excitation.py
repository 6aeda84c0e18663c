# SPDX-License-Identifier: Apache-2.0
"""Whether the inputs say anything new: the gate that pauses a row in quiet flight.

In quiet flight the autopilot's surfaces answer the gusts, and an estimator that goes on
learning learns the autopilot. Forgetting by direction does not help, pausing the row does. In
severe turbulence the answers are as large as any excitation: then it is the effect of the inputs,
small beside that of the gusts, that gives them away.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import INPUT_COLUMNS, BoolArray, FloatArray

WINDOW_TIME = 3.0
"""Time over which the variance of an input is taken, s: a slow multisine still moves in it."""

LOOK_TIME = 0.25
"""Time between two looks at the window, s."""

NEWEST_PART = 3
"""The residuals are taken over the newest third of the window: a gust front shows at once."""

CLEAR_SIGNAL = 0.5
"""Variance that the inputs explain in a row, relative to that of the residual, below which they
do not stand out: in a storm, an autopilot's answers look like a change, and large residuals are
no reason to learn."""

LIKELY_SIGMAS = 2.0
"""An input may have this many standard deviations more effect than is known."""


class ExcitationGate:
    """Tells which rows see excitation.

    A row learns while at least one of its inputs is lively, and while its inputs, for all that
    is known of their effect, could explain a part of what moves the aircraft.

    Parameters
    ----------
    free : (3, n) bool array
        Coefficients that move; a row watches the inputs that it has a coefficient for.
    settings : SupervisionSettings
        Thresholds.

    Attributes
    ----------
    settings : SupervisionSettings
        The parameter; it may change at any time.
    share : (4,) array
        Variance of each input over the window, relative to its mean while learning. Relative
        to the largest one, one wild manoeuvre would close the gate for an ordinary flight.
    signal : (3,) array
        Variance that the inputs explain in each row, relative to that of the residual.
    learning : (3,) bool array
        Rows that see excitation.
    clear : (3,) bool array
        Those of them in which the inputs stand out from all else that moves the aircraft.
    quiet : (n,) bool array
        Regressors that are inputs and say nothing at present.
    """

    def __init__(self, free: BoolArray, settings: SupervisionSettings) -> None:
        self.settings = settings
        self._watched: BoolArray = free[:, INPUT_COLUMNS]
        self._window: deque[FloatArray] = deque()
        self._window_time = 0.0
        self._since_look = 0.0
        self._usual: FloatArray = np.zeros(4)
        self._usual_time: FloatArray = np.zeros(4)
        self.share: FloatArray = np.zeros(4)
        self.signal: FloatArray = np.zeros(3)
        self.learning: BoolArray = np.ones(3, dtype=bool)
        self.clear: BoolArray = np.ones(3, dtype=bool)
        self.quiet: BoolArray = np.zeros(free.shape[1], dtype=bool)

    def update(
        self, data: Regression, residual: FloatArray, coefficients: FloatArray, sigma: FloatArray
    ) -> BoolArray:
        """Return which rows may learn from the samples of this tick, shape (3,).

        Parameters
        ----------
        data : Regression
            Samples of the tick.
        residual : (m, 3) array
            Their residuals, rad/s^2.
        coefficients, sigma : (3, n) arrays
            What is known, and how well.
        """
        u = data.f[:, INPUT_COLUMNS]
        sums = (np.add.reduce(u), np.add.reduce(u * u), np.add.reduce(residual * residual))
        self._window.append(data.dt * np.concatenate(((len(u),), *sums)))
        self._since_look += data.time
        if self._since_look >= LOOK_TIME or len(self._window) == 1:
            self._look(coefficients[:, INPUT_COLUMNS], sigma[:, INPUT_COLUMNS])
        return self.learning

    def _look(self, effect: FloatArray, sigma: FloatArray) -> None:
        """Compare the inputs over the window with what is usual, and with the residuals."""
        elapsed, self._since_look = self._since_look, 0.0
        self._window_time += elapsed
        while self._window_time > WINDOW_TIME and len(self._window) > 1:
            self._window_time -= self._window.popleft()[0]
        # Time, and the sums of u, u^2 and the squared residuals over it.
        sums = np.concatenate(self._window).reshape(-1, 12)
        means = np.add.reduce(sums)
        means /= means[0]
        newest = np.add.reduce(sums[len(sums) - len(sums) // NEWEST_PART - 1 :])
        variance = np.maximum(means[5:9] - means[1:5] ** 2, 0.0)
        self.share = np.divide(variance, self._usual, out=np.ones(4), where=self._usual > 0.0)
        self.quiet[INPUT_COLUMNS] = self.share < self.settings.min_excitation
        lively = self._watched & (self.share >= self.settings.min_excitation)
        residual = np.maximum(newest[9:] / newest[0], np.finfo(float).tiny)
        self.signal = (self._watched * effect**2) @ variance / residual
        largest = self._watched * (np.abs(effect) + LIKELY_SIGMAS * sigma)
        audible = largest**2 @ variance >= self.settings.min_signal * residual
        self.learning = (lively.any(axis=1) & audible) | ~self._watched.any(axis=1)
        self.clear = self.learning & (self.signal >= CLEAR_SIGNAL)
        heard = (self._watched & self.learning[:, None]).any(axis=0)
        spent = np.where(heard, elapsed, 0.0)
        self._usual_time += spent
        self._usual += spent / np.maximum(self._usual_time, elapsed) * (variance - self._usual)
