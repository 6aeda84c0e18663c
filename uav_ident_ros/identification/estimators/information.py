# SPDX-License-Identifier: Apache-2.0
"""Accumulated information: ``R = sum z f^T``, ``r = sum z y`` for each row.

With ``z = f`` the solution of ``R a = r`` is least squares, with ``z`` the regressors of the
model's own state it is the instrumental variable. Both are the law ``Am_dot = e f^T K`` with
the gain ``K = R^-1``: computed, not chosen.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import FloatArray

BLOCK_TIME = 1.0
"""Length of the blocks whose scores are taken as independent, s: longer than the correlation
of gusts and filter."""

RESIDUAL_TIME = 30.0
"""Memory of the running residual variance, s."""

_RIDGE = 1e-9
"""Relative to a regressor's own information: keeps the solution defined where columns are
collinear."""


class Information:
    """Information of three rows, with forgetting and prior.

    Parameters
    ----------
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    forgetting_time : float
        Time constant of forgetting, s; 0 for never.
    """

    def __init__(self, start: Start, forgetting_time: float = 0.0) -> None:
        n = start.values.shape[1]
        self._start = start
        self._forgetting_time = forgetting_time
        self._precision = start.precision
        self._pairs = start.free[:, :, None] & start.free[:, None, :]
        self.matrix: FloatArray = np.zeros((3, n, n))
        self.vector: FloatArray = np.zeros((3, n))
        self.residual_variance: FloatArray = np.zeros(3)
        self.time = 0.0
        self._scores: FloatArray = np.zeros((3, n, n))
        self._score: FloatArray = np.zeros((3, n))
        self._score_time = 0.0
        self._blocks = 0.0

    def accumulate(self, data: Regression, z: FloatArray, coefficients: FloatArray) -> None:
        """Add the samples of a tick.

        Parameters
        ----------
        data : Regression
            Samples of y = A f.
        z : (m, n) array
            Instruments.
        coefficients : (3, n) array
            The estimate before the tick, from which the residuals are taken.
        """
        dt = data.dt * len(data.y)
        residual = data.y - data.f @ coefficients.T
        self.time += dt
        share = dt / min(self.time, RESIDUAL_TIME)
        self.residual_variance += share * ((residual**2).mean(axis=0) - self.residual_variance)
        if self._forgetting_time > 0.0:
            keep = np.exp(-dt / self._forgetting_time)
            self.matrix *= keep
            self.vector *= keep
            self._scores *= keep**2
            self._blocks *= keep
        weighted = z.T * data.dt
        self.matrix += weighted @ data.f
        # Deviations from the start, so that what is fixed or unexcited stays where it is.
        self.vector += (weighted @ (data.y - data.f @ self._start.values.T)).T
        self._score += (weighted @ residual).T
        self._score_time += dt
        if self._score_time >= BLOCK_TIME:
            self._scores += self._score[:, :, None] * self._score[:, None, :]
            self._score[:] = 0.0
            self._score_time = 0.0
            self._blocks += 1.0

    def _system(self) -> FloatArray:
        """Regularised matrix of each row; identity along what is not free, (3, n, n)."""
        prior = self._precision * self.residual_variance[:, None]
        matrix = np.where(self._pairs, self.matrix, 0.0)
        diagonal = np.einsum("ijj->ij", matrix)
        diagonal += prior + _RIDGE * np.abs(diagonal)
        diagonal[diagonal == 0.0] = 1.0
        return matrix

    def solve(self) -> FloatArray:
        """Coefficients that satisfy ``R a = r`` with the prior, shape (3, n)."""
        vector = np.where(self._start.free, self.vector, 0.0)
        deviation = np.linalg.solve(self._system(), vector[:, :, None])[:, :, 0]
        return np.asarray(self._start.values + deviation)

    def sigma(self, coefficients: FloatArray) -> FloatArray:
        """Standard deviations of the coefficients, shape (3, n).

        ``R^-1 S R^-T`` with S the sum of the outer products of the scores of one-second
        blocks: it holds for residuals coloured within a block, where ``s^2 R^-1`` is several
        times too small (block-mean form of Morelli and Klein 1997).
        """
        free = self._start.free
        if self._blocks < 1.0:
            return np.where(free, self._start.sigma, 0.0)
        inverse = np.linalg.inv(self._system())
        # Few blocks: their scatter underestimates; p coefficients cost p degrees of freedom.
        p = free.sum(axis=1)
        correction = (self._blocks / np.maximum(self._blocks - p, 1.0))[:, None, None]
        prior = np.einsum(
            "ij,jk->ijk", self._precision * self.residual_variance[:, None] ** 2, np.eye(free.shape[1])
        )
        middle = np.where(self._pairs, self._scores * correction + prior, 0.0)
        covariance = inverse @ middle @ inverse.transpose(0, 2, 1)
        variance = np.maximum(np.einsum("ijj->ij", covariance), 0.0)
        return np.where(free, np.sqrt(variance), 0.0)
