# SPDX-License-Identifier: Apache-2.0
"""The noise model: what each row's residual has in common with its own past.

Gusts and the model's own errors are slow, and an autopilot answers them. An autoregressive model
of the residual makes it white, and with it everything that is held against it: regressors,
instruments, inputs (prewhitening; Box, Jenkins and Reinsel, Time Series Analysis, 2008).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.regression import RowSamples
from uav_ident_ros.identification.scales import LOOK_TIME, MEMORY
from uav_ident_ros.identification.structure import FloatArray

ORDER = 3
"""Order of the autoregression, samples: gust, filter and one more."""

LOADING = 0.01
"""White noise added to the autocovariances, relative to the variance: keeps what is left of a
slow input after whitening above what rounding and sampling leave."""


class NoiseModel:
    """Autoregressive models of the residuals of several rows.

    Parameters
    ----------
    rows : int
        Number of rows.

    Attributes
    ----------
    weights : (rows, ORDER) array
        What is predicted of a residual from those before it, the newest first.
    variance : (rows,) array
        Variance of the innovation: of what is left.
    """

    def __init__(self, rows: int) -> None:
        self.weights: FloatArray = np.zeros((rows, ORDER))
        self.variance: FloatArray = np.zeros(rows)
        self._covariances: FloatArray = np.zeros((rows, ORDER + 1))
        self._time = self._since_fit = 0.0
        self._lags = np.abs(np.subtract.outer(np.arange(ORDER), np.arange(ORDER)))
        # What turns `ORDER` + m signals into m innovations, (rows, m, `ORDER` + m)
        self._matrices: dict[int, FloatArray] = {}
        self._past: FloatArray | None = None
        self._known = 0

    def whiten(self, samples: RowSamples, *, restarted: bool) -> RowSamples:
        """Learn from the residuals of samples, and whiten them.

        Parameters
        ----------
        samples : RowSamples
            m samples.
        restarted : bool
            Whether the first does not continue those before.

        Returns
        -------
        RowSamples
            The same, their residuals are innovations; zeros in the place of the first `ORDER` after
            a restart.
        """
        new = samples.signals
        if restarted or self._past is None:
            self._past, self._known = np.zeros((len(new), ORDER, new.shape[2])), 0
        signals = np.concatenate((self._past, new), axis=1)
        self._past = signals[:, -ORDER:]
        m = new.shape[1]
        self._learn(signals[:, :, 0], samples.dt)
        if m not in self._matrices:
            matrix = self._matrices[m] = np.zeros((len(self.weights), m, ORDER + m))
            for k in range(m):
                matrix[:, k, k : k + ORDER] = -self.weights[:, ::-1]
                matrix[:, k, k + ORDER] = 1.0
        white = self._matrices[m] @ signals
        if self._known < ORDER:
            white[:, : ORDER - self._known] = 0.0
            self._known += m
        return RowSamples(white, samples.dt)

    def _learn(self, residual: FloatArray, dt: float) -> None:
        """Take residuals (rows, ORDER + m), the first `ORDER` of which are known already."""
        new = residual[:, ORDER:]
        m = new.shape[1]
        self._time += m * dt
        share = min(m * dt / min(self._time, MEMORY), 1.0)
        lagged = residual[:, _lags(m)]
        products = (lagged @ new[:, :, None])[:, :, 0]
        self._covariances += share * (products / m - self._covariances)
        self._since_fit += m * dt
        if self._since_fit >= LOOK_TIME:
            self._since_fit = 0.0
            self._fit()

    def _fit(self) -> None:
        """Solve the Yule-Walker equations."""
        c = self._covariances
        matrix = c[:, self._lags]
        level = np.maximum(c[:, 0], np.finfo(float).tiny)
        np.einsum("ijj->ij", matrix)[...] += (LOADING * level)[:, None]
        self.weights = np.linalg.solve(matrix, c[:, 1:, None])[:, :, 0]
        self._matrices.clear()
        left = c[:, 0] - (self.weights * c[:, 1:]).sum(axis=1)
        self.variance = np.maximum(left, LOADING * c[:, 0])


@lru_cache(maxsize=64)
def _lags(m: int) -> NDArray[np.intp]:
    """Places of the m newest of `ORDER` + m samples and of those before them, a lag a row."""
    return np.add.outer(np.arange(ORDER, -1, -1), np.arange(m))
