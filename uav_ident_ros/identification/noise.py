# SPDX-License-Identifier: Apache-2.0
"""The noise model: what each row's residual has in common with its own past.

Gusts and the model's own errors are slow, and an autopilot answers them. An autoregressive model
of the residual makes it white, and with it everything that is held against it: regressors,
instruments, inputs (prewhitening; Box, Jenkins and Reinsel, Time Series Analysis, 2008).
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

ORDER = 3
"""Order of the autoregression, ticks: gust, filter and one more."""

MEMORY = 30.0
"""Time constant of the residual's running autocovariances, s."""

FIT_TIME = 0.5
"""Time between two fits, s: far less than the memory."""

LOADING = 0.01
"""White noise added to the autocovariances, relative to the variance: keeps what is left of a
slow input after whitening above what rounding and sampling leave."""


class NoiseModel:
    """Autoregressive models of the residuals of several rows, a tick at a time.

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
        self._covariances: FloatArray = np.zeros((ORDER + 1, rows))
        self._past: FloatArray = np.zeros((ORDER + 1, rows))
        self._time = self._since_fit = 0.0
        self._lags = np.abs(np.subtract.outer(np.arange(ORDER), np.arange(ORDER)))

    def restart(self) -> None:
        """Begin a new stretch: what comes does not continue what was."""
        self._past[:] = 0.0

    def add(self, residual: FloatArray, dt: float) -> None:
        """Take the residuals of a tick, shape (rows,), that stand for `dt` s."""
        self._past[1:] = self._past[:-1].copy()
        self._past[0] = residual
        self._time += dt
        share = min(dt / min(self._time, MEMORY), 1.0)
        self._covariances += share * (self._past * residual - self._covariances)
        self._since_fit += dt
        if self._since_fit >= FIT_TIME:
            self._since_fit = 0.0
            self._fit()

    def _fit(self) -> None:
        """Solve the Yule-Walker equations."""
        c = self._covariances
        matrix = c[self._lags].transpose(2, 0, 1).copy()
        level = np.maximum(c[0], np.finfo(float).tiny)
        np.einsum("ijj->ij", matrix)[...] += (LOADING * level)[:, None]
        self.weights = np.linalg.solve(matrix, c[1:].T[:, :, None])[:, :, 0]
        self.variance = np.maximum(c[0] - (self.weights * c[1:].T).sum(axis=1), LOADING * c[0])


class Whitener:
    """Signals through the noise models of their rows.

    Parameters
    ----------
    shape : tuple of int
        Shape of the signals of a tick; its first axis are the rows.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._past: FloatArray = np.zeros((ORDER, *shape))
        self._known = 0

    def restart(self) -> None:
        """Begin a new stretch."""
        self._known = 0

    def apply(self, signals: FloatArray, noise: NoiseModel) -> FloatArray | None:
        """Return the signals less what the noise model predicts; None while too few are known."""
        white = None
        if self._known >= ORDER:
            weights = noise.weights.T.reshape(ORDER, -1, *(1,) * (signals.ndim - 1))
            white = signals - np.add.reduce(weights * self._past)
        self._past[1:] = self._past[:-1].copy()
        self._past[0] = signals
        self._known += 1
        return white
