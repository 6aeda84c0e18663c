# SPDX-License-Identifier: Apache-2.0
"""How far the inputs answer what disturbs the aircraft: feedback is not information.

A gust moves the aircraft, an autopilot answers, and the input is correlated with the gust: the
estimate of a control derivative is then off by ``cov(u, w) / var(u)``, and no residual shows it.
What a gust alone makes of the motion is what the model's run on the inputs does not explain. If
that motion explains the share R^2 of an input, the error is at most ``R sigma_w / sigma_u``, and
sigma is at least that (Soderstrom and Stoica, System Identification, 1989, ch. 10).
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
        self._information: FloatArray = np.zeros((self._columns, self._columns))
        self._product: FloatArray = np.zeros((self._columns, len(INPUTS)))
        self._input_square: FloatArray = np.zeros(len(INPUTS))
        self._residual_square: FloatArray = np.zeros(len(ROWS))
        self._time = 0.0
        self._since_look = 0.0
        self.share: FloatArray = np.zeros(len(INPUTS))
        self.bound: FloatArray = np.zeros((len(ROWS), len(INPUTS)))

    def add(self, sample: Regression, residual: FloatArray, weight: FloatArray) -> None:
        """Take one tick.

        Parameters
        ----------
        sample : Regression
            Mean of the tick's samples; its instruments are the model's run on all inputs.
        residual : (3,) array
            Its residuals in the moment rows, rad/s^2.
        weight : (3,) array
            How much the rows learn from it, 0 ... 1.
        """
        if sample.restarted:
            self._angles[:] = 0.0
        dt = sample.time
        disturbed = sample.f[0] - sample.z[0]
        rates = disturbed[RATE_COLUMNS]
        self._angles += dt * (rates - self._angles / ANGLE_TIME)
        force = disturbed[LAST_COLUMNS] if self._forces else ()
        motion = np.concatenate((rates, self._angles, force, (1.0,)))
        counted = dt * float(weight.max())
        keep = np.exp(-counted / MEMORY)
        inputs = sample.f[0, INPUT_COLUMNS]
        self._information = keep * self._information + counted * np.outer(motion, motion)
        self._product = keep * self._product + counted * np.outer(motion, inputs)
        self._input_square = keep * self._input_square + counted * inputs * inputs
        self._residual_square = keep * self._residual_square + counted * residual * residual
        self._time = keep * self._time + counted
        self._since_look += dt
        if self._since_look >= LOOK_TIME and self._time > 0.0:
            self._since_look = 0.0
            self._look()

    def _look(self) -> None:
        matrix = self._information.copy()
        diagonal = np.einsum("jj->j", matrix)
        diagonal += LOADING * diagonal + np.finfo(float).tiny
        slopes = np.linalg.solve(matrix, self._product)
        mean_input = self._product[-1] / self._time
        variance = self._input_square / self._time - mean_input**2
        mean = self._information[-1] / self._time
        covariance = self._information / self._time - np.outer(mean, mean)
        explained = np.einsum("ji,jk,ki->i", slopes, covariance, slopes)
        moved = variance > np.finfo(float).tiny
        share = np.divide(explained, variance, out=np.zeros(len(INPUTS)), where=moved)
        by_chance = self._columns * CORRELATION_TIME / self._time
        self.share = np.clip(share - by_chance, 0.0, 1.0)
        ratio = np.divide(self.share, variance, out=np.zeros(len(INPUTS)), where=moved)
        self.bound = np.sqrt(np.outer(self._residual_square / self._time, ratio))
