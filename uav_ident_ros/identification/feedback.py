# SPDX-License-Identifier: Apache-2.0
"""How far the inputs answer what disturbs the aircraft: feedback is not information.

A gust moves the aircraft, an autopilot answers, and the input is correlated with the gust: the
estimate of a control derivative is then off by ``cov(u, w) / var(u)``, and no residual shows it.
What a gust alone makes of the motion is what the model's run on the inputs does not explain. If
that motion explains the share R^2 of an input, the error is at most ``R sigma_w / sigma_u``, and of
the disturbance w the residual e shows ``sigma_e = sigma_w sqrt(1 - R^2)``: the rest went into the
estimate. So sigma is at least ``R / sqrt(1 - R^2) sigma_e / sigma_u`` (Soderstrom and Stoica,
System Identification, 1989, ch. 10).
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    LAST_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    FloatArray,
)

MEMORY = 60.0
"""Time constant of the running sums, s."""

ANGLE_TIME = 5.0
"""Leak of the angles that the disturbed rates add up to, s: an autopilot holds attitudes too."""

LOOK_TIME = 1.0
"""Time between two looks, s."""

CORRELATION_TIME = 0.3
"""Time after which disturbances count as independent, s."""

LOADING = 1e-6
"""Added to the information, relative to its diagonal."""


class Feedback:
    """Follows how much of the inputs the disturbed motion explains.

    Parameters
    ----------
    forces : bool
        Whether there are regressors for ay and az.

    Attributes
    ----------
    share : (4,) array
        Share R^2 of each input that the disturbed motion explains, 0 ... 1.
    bound : (3, 4) array
        Largest error of each control derivative of the moment rows, from that.
    """

    def __init__(self, *, forces: bool) -> None:
        self._forces = forces
        self._columns = 7 + 2 * forces  # rates, angles, forces, constant
        self._angles: FloatArray = np.zeros(len(ROWS))
        size = self._columns + len(INPUTS)
        self._products: FloatArray = np.zeros((size, size))
        self._residual_square: FloatArray = np.zeros(len(ROWS))
        self._since_look = 0.0
        self.share: FloatArray = np.zeros(len(INPUTS))
        self.bound: FloatArray = np.zeros((len(ROWS), len(INPUTS)))

    def add(self, samples: Regression, residual: FloatArray, weight: FloatArray) -> None:
        """Take samples.

        Parameters
        ----------
        samples : Regression
            m samples; their instruments are the model's run on all inputs.
        residual : (m, 3) array
            Their residuals in the moment rows, rad/s^2.
        weight : (3,) array
            How much the rows learn from them, 0 ... 1.
        """
        if samples.restarted:
            self._angles = np.zeros(len(ROWS))
        dt, m = samples.dt, len(residual)
        disturbed, inputs = samples.f - samples.z, samples.f[:, INPUT_COLUMNS]
        rates = disturbed[:, RATE_COLUMNS]
        angles = np.empty_like(rates)
        for k in range(m):
            self._angles = self._angles + dt * (rates[k] - self._angles / ANGLE_TIME)
            angles[k] = self._angles
        force = disturbed[:, LAST_COLUMNS] if self._forces else disturbed[:, :0]
        if not samples.f[:, LAST_COLUMNS].any():  # no accelerometer tells of a disturbed force
            force = np.zeros_like(force)
        motion = np.concatenate((rates, angles, force, np.ones((m, 1))), axis=1)
        counted = dt * float(weight.max())
        keep = np.exp(-m * counted / MEMORY)
        signals = np.concatenate((motion, inputs), axis=1)
        self._products = keep * self._products + counted * (signals.T @ signals)
        square = np.add.reduce(residual * residual)
        self._residual_square = keep * self._residual_square + counted * square
        self._since_look += m * dt
        counted_time = self._products[self._columns - 1, self._columns - 1]
        if self._since_look >= LOOK_TIME and counted_time > 0.0:
            self._since_look = 0.0
            self._look()

    def _look(self) -> None:
        n = self._columns
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
        self.share = np.clip(share - n * CORRELATION_TIME / time, 0.0, 1.0)
        told = np.maximum(1.0 - self.share, np.finfo(float).tiny) * variance
        ratio = np.divide(self.share, told, out=np.zeros(len(INPUTS)), where=moved)
        self.bound = np.sqrt(np.outer(self._residual_square / time, ratio))
