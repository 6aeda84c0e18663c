# SPDX-License-Identifier: Apache-2.0
"""How far the inputs answer what disturbs the aircraft: feedback is not information.

A gust moves the aircraft, an autopilot answers, and the input is correlated with the gust w: no
residual shows it, and no time averages it away. But the answer comes after the gust: past
residuals explain a share R^2 of an input that is fed back, and nothing of one that is not (the test
of residuals against future inputs; Ljung, System Identification, 1999, ch. 13 and 16). Of w the
residual e shows ``sigma_e = sigma_w sqrt(1 - R^2)``, the rest went into the estimate. So over a
time T the sum of ``z w``, by which the estimate is off, is at most (Cauchy and Schwarz)

    C = T sigma_e^2 S_q,  S_q = sum q z z^T,  q = R^2 / (1 - R^2),

where the sum of independent disturbances has a correlation time in place of T.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    ROWS,
    FloatArray,
)

MEMORY = 60.0
"""Time constant of the running sums, s."""

ANSWER_TIMES = np.array([0.1, 0.5, 2.5])
"""Time constants in which past residuals fade, s: from a rate loop to one that holds attitudes."""

LOOK_TIME = 1.0
"""Time between two looks, s."""

CORRELATION_TIME = 0.3
"""Time after which disturbances count as independent, s."""

LEAST_T = 3.0
"""Standard deviations from which a share is more than chance."""

LOADING = 1e-6
"""Added to the information, relative to its diagonal."""

LARGEST_SHARE = 0.99
"""Share of an input beyond which nothing of it is anything but an answer."""


class Feedback:
    """Follows how much of the inputs past residuals explain.

    Attributes
    ----------
    share : (4,) array
        Share R^2 of each input that is an answer to disturbances, 0 ... 1.
    """

    def __init__(self) -> None:
        self._past: FloatArray = np.zeros((len(ANSWER_TIMES), len(ROWS)))
        self._answers = self._past.size + 1  # and the constant
        size = self._answers + len(INPUTS)
        self._products: FloatArray = np.zeros((size, size))
        self._since_look = 0.0
        self.share: FloatArray = np.zeros(len(INPUTS))

    @property
    def ratio(self) -> FloatArray:
        """``R^2 / (1 - R^2)`` of each input, (4,)."""
        return self.share / (1.0 - self.share)

    def add(self, samples: Regression, residual: FloatArray, weight: FloatArray) -> None:
        """Take samples.

        Parameters
        ----------
        samples : Regression
            m samples.
        residual : (m, 3) array
            Their residuals in the moment rows, rad/s^2.
        weight : (3,) array
            How much the rows learn from them, 0 ... 1.
        """
        if samples.restarted:
            self._past = np.zeros_like(self._past)
        dt, m = samples.dt, len(residual)
        keep = np.exp(-dt / ANSWER_TIMES)[:, None]
        signals = np.ones((m, len(self._products)))
        signals[:, self._answers :] = samples.f[:, INPUT_COLUMNS]
        for k in range(m):
            signals[k, : self._past.size] = self._past.ravel()
            self._past = keep * self._past + residual[k]
        counted = dt * float(weight.max())
        fade = np.exp(-m * counted / MEMORY)
        self._products = fade * self._products + counted * (signals.T @ signals)
        self._since_look += m * dt
        if self._since_look >= LOOK_TIME and self._products[-1 - len(INPUTS), -1 - len(INPUTS)]:
            self._since_look = 0.0
            self._look()

    def _look(self) -> None:
        n = self._answers
        time = self._products[n - 1, n - 1]
        mean = self._products[n - 1] / time
        covariance = self._products / time - np.outer(mean, mean)
        matrix = covariance[: n - 1, : n - 1].copy()
        diagonal = np.einsum("jj->j", matrix)
        diagonal += LOADING * diagonal + np.finfo(float).tiny
        across = covariance[: n - 1, n:]
        explained = np.einsum("ji,ji->i", across, np.linalg.solve(matrix, across))
        variance = np.diag(covariance)[n:]
        moved = variance > np.finfo(float).tiny
        share = np.divide(explained, variance, out=np.zeros(len(INPUTS)), where=moved)
        # By chance n regressors explain n samples' worth, give or take sqrt(2 n).
        chance = (n - 1) * CORRELATION_TIME / time
        sure = share > chance * (1.0 + LEAST_T * np.sqrt(2.0 / (n - 1)))
        self.share = np.where(sure, np.clip(share - chance, 0.0, LARGEST_SHARE), 0.0)
