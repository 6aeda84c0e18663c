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

from uav_ident_ros.identification.regression import Layout, Regression
from uav_ident_ros.identification.scales import (
    GUST_TIME,
    INDEPENDENT_TIME,
    LONG_MEMORY,
    ROUNDING,
    SURE,
)
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    ROWS,
    FloatArray,
)

ANSWER_TIMES = np.array([0.1, 0.5, 2.5])
"""Time constants in which past residuals fade, s: from a rate loop to one that holds attitudes."""


class Feedback:
    """Follows how much of the inputs past residuals explain.

    Parameters
    ----------
    layout : Layout
        The regression problem.

    Attributes
    ----------
    share : (4,) array
        Share R^2 of each input that is an answer to disturbances, 0 ... 1.
    ratio : (rows, k) array
        ``q = R^2 / (1 - R^2)`` of the input that each instrument follows.
    answering : (rows, k, k) array or None
        Root of the product of q of each pair of instruments; None where nothing answers.
    """

    def __init__(self, layout: Layout) -> None:
        self._driven_by = layout.driven_by
        self._past: FloatArray = np.zeros((len(ANSWER_TIMES), len(ROWS)))
        self._answers = self._past.size + 1  # and the constant
        size = self._answers + len(INPUTS)
        self._products: FloatArray = np.zeros((size, size))
        self._gathered: list[tuple[Regression, FloatArray, float]] = []
        self._since_look = 0.0
        self._set_share(np.zeros(len(INPUTS)))

    def _set_share(self, share: FloatArray) -> None:
        self.share = share
        self.ratio: FloatArray = (share / (1.0 - share))[self._driven_by]
        root = np.sqrt(self.ratio)
        answering = root[:, :, None] * root[:, None, :]
        self.answering: FloatArray | None = answering if share.any() else None

    def add(self, samples: Regression, residual: FloatArray, weight: FloatArray) -> None:
        """Take samples; they are looked at every `INDEPENDENT_TIME`.

        Parameters
        ----------
        samples : Regression
            m samples.
        residual : (m, 3) array
            Their residuals in the moment rows, rad/s^2.
        weight : (3,) array
            How much the rows learn from them, 0 ... 1.
        """
        self._gathered.append((samples, residual, samples.dt * max(weight.tolist())))
        self._since_look += samples.time
        if self._since_look >= INDEPENDENT_TIME:
            self._since_look = 0.0
            self._count()
            if self._products[self._answers - 1, self._answers - 1]:
                self._look()

    def _count(self) -> None:
        """Add up the products of the samples that were gathered."""
        gathered, self._gathered = self._gathered, []
        signals = np.ones((sum(len(residual) for _, residual, _ in gathered), len(self._products)))
        weight, first = np.empty((len(signals), 1)), 0
        for samples, residual, counted in gathered:
            if samples.restarted:
                self._past = np.zeros_like(self._past)
            keep = np.exp(-samples.dt / ANSWER_TIMES)[:, None]
            last = first + len(residual)
            signals[first:last, self._answers :] = samples.f[:, INPUT_COLUMNS]
            for k in range(first, last):
                signals[k, : self._past.size] = self._past.ravel()
                self._past = keep * self._past + residual[k - first]
            fade = np.exp(-counted * len(residual) / LONG_MEMORY)
            self._products *= fade
            weight[:first] *= fade
            weight[first:last] = counted
            first = last
        self._products += (weight * signals).T @ signals

    def _look(self) -> None:
        n = self._answers
        time = self._products[n - 1, n - 1]
        mean = self._products[n - 1] / time
        covariance = self._products / time - np.outer(mean, mean)
        matrix = covariance[: n - 1, : n - 1].copy()
        diagonal = np.einsum("jj->j", matrix)
        diagonal += ROUNDING * diagonal + np.finfo(float).tiny
        across = covariance[: n - 1, n:]
        explained = np.einsum("ji,ji->i", across, np.linalg.solve(matrix, across))
        variance = np.diag(covariance)[n:]
        moved = variance > np.finfo(float).tiny
        share = np.divide(explained, variance, out=np.zeros(len(INPUTS)), where=moved)
        # By chance n regressors explain n samples' worth, give or take sqrt(2 n).
        chance = (n - 1) * GUST_TIME / time
        sure = share > chance * (1.0 + SURE * np.sqrt(2.0 / (n - 1)))
        self._set_share(np.where(sure, share - chance, 0.0))
