# SPDX-License-Identifier: Apache-2.0
"""What the inputs still explain of the residual: the model's own error, as a share of their effect.

A servo lag or a delay that is not modelled leaves a residual that follows the inputs of the last
tenths of a second, a surface that saturates one that follows their square and their sign. Neither
is noise: the control derivative is off by about as much (a model error model; Ljung, System
Identification, 1999, ch. 16). So sigma of a control derivative is at least this share of its value.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    MAIN_INPUTS,
    ROWS,
    FloatArray,
)

LAGS = 4
"""Samples back to which the residual is held against an input: 0.2 s, a slow servo's lag."""

MEMORY = 60.0
"""Time constant of the running sums, s."""

LOOK_TIME = 1.0
"""Time between two looks, s."""

CORRELATION_TIME = 0.3
"""Time after which residuals count as independent, s: that of gusts on a small aircraft."""

LOADING = 1e-4
"""Added to the information, relative to its diagonal: neighbouring inputs are alike."""

_COLUMNS = LAGS + 4  # the input now and before, its signed square, its sign, the constant
_MAIN = [INPUTS.index(MAIN_INPUTS[row]) for row in ROWS]


class ModelError:
    """Follows what the main input of each moment row still explains of its residual.

    Attributes
    ----------
    share : (3,) array
        Rms of what is explained, relative to that of the input's modelled effect.
    """

    def __init__(self) -> None:
        self._inputs: FloatArray = np.zeros((0, len(ROWS)))
        self._information: FloatArray = np.zeros((len(ROWS), _COLUMNS, _COLUMNS))
        self._product: FloatArray = np.zeros((len(ROWS), _COLUMNS))
        self._square: FloatArray = np.zeros(len(ROWS))
        self._time: FloatArray = np.zeros(len(ROWS))
        self._since_look = 0.0
        self.share: FloatArray = np.zeros(len(ROWS))

    def forget(self, row: int) -> None:
        """Forget what a row has shown: it is learned anew."""
        for part in (self._information, self._product, self._square, self._time, self.share):
            part[row] = 0.0

    def add(
        self,
        samples: Regression,
        residual: FloatArray,
        derivatives: FloatArray,
        weight: FloatArray,
    ) -> None:
        """Take samples.

        Parameters
        ----------
        samples : Regression
            m samples.
        residual : (m, 3) array
            Their residuals, rad/s^2.
        derivatives : (3, 4) array
            Control derivatives that go with them.
        weight : (3,) array
            How much the rows learn from them, 0 ... 1.
        """
        inputs = samples.f[:, INPUT_COLUMNS][:, _MAIN]
        if not samples.restarted:
            inputs = np.concatenate((self._inputs, inputs))
        self._inputs = inputs[-LAGS:]
        m = min(len(inputs) - LAGS, len(residual))
        if m <= 0:
            return
        residual, now = residual[-m:].T, inputs[-m:].T
        past = [inputs[len(inputs) - m - lag : len(inputs) - lag].T for lag in range(LAGS + 1)]
        f = np.stack((*past, now * np.abs(now), np.sign(now), np.ones_like(now)), axis=1)
        dt = weight * samples.dt
        keep = np.exp(-m * dt / MEMORY)
        weighted = f * dt[:, None, None]
        self._information *= keep[:, None, None]
        self._information += weighted @ f.transpose(0, 2, 1)
        self._product *= keep[:, None]
        self._product += (weighted @ residual[:, :, None])[:, :, 0]
        self._square = keep * self._square + dt * np.add.reduce(residual * residual, axis=1)
        self._time = keep * self._time + m * dt
        self._since_look += samples.time
        if self._since_look >= LOOK_TIME:
            self._since_look = 0.0
            self._look(derivatives[np.arange(len(ROWS)), _MAIN])

    def _look(self, derivatives: FloatArray) -> None:
        """Solve for what is explained, less what noise alone would seem to explain."""
        matrix = self._information.copy()
        diagonal = np.einsum("ijj->ij", matrix)
        diagonal += LOADING * diagonal + np.finfo(float).tiny
        slopes = np.linalg.solve(matrix, self._product[:, :, None])[:, :, 0]
        time = np.maximum(self._time, np.finfo(float).tiny)
        mean = self._information[:, -1] / time[:, None]
        covariance = self._information - time[:, None, None] * mean[:, :, None] * mean[:, None, :]
        explained = np.einsum("ij,ijk,ik->i", slopes, covariance, slopes)
        by_chance = 2.0 * _COLUMNS * CORRELATION_TIME / time * self._square
        effect = derivatives**2 * covariance[:, 0, 0]
        share = np.divide(
            explained - by_chance, effect, out=np.zeros(len(ROWS)), where=effect > 0.0
        )
        self.share = np.sqrt(np.maximum(share, 0.0))
