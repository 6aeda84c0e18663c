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
"""Ticks back to which the residual is held against an input: 0.2 s, a slow servo's lag."""

MEMORY = 60.0
"""Time constant of the running sums, s."""

LOOK_TIME = 1.0
"""Time between two looks, s."""

CORRELATION_TIME = 0.3
"""Time after which residuals count as independent, s: that of gusts on a small aircraft."""

LOADING = 1e-4
"""Added to the information, relative to its diagonal: inputs of neighbouring ticks are alike."""

_COLUMNS = LAGS + 4  # the input now and before, its signed square, its sign, the constant


class ModelError:
    """Follows what the main input of each moment row still explains of its residual.

    Attributes
    ----------
    share : (3,) array
        Rms of what is explained, relative to that of the input's modelled effect.
    """

    def __init__(self) -> None:
        self._main = [INPUTS.index(MAIN_INPUTS[row]) for row in ROWS]
        self._past: FloatArray = np.zeros((LAGS + 1, len(ROWS)))
        self._information: FloatArray = np.zeros((len(ROWS), _COLUMNS, _COLUMNS))
        self._product: FloatArray = np.zeros((len(ROWS), _COLUMNS))
        self._square: FloatArray = np.zeros(len(ROWS))
        self._time: FloatArray = np.zeros(len(ROWS))
        self._known = 0
        self._since_look = 0.0
        self.share: FloatArray = np.zeros(len(ROWS))

    def forget(self, row: int) -> None:
        """Forget what a row has shown: it is learned anew."""
        for part in (self._information, self._product, self._square, self._time, self.share):
            part[row] = 0.0

    def add(
        self,
        sample: Regression,
        residual: FloatArray,
        derivatives: FloatArray,
        weight: FloatArray,
    ) -> None:
        """Take one tick.

        Parameters
        ----------
        sample : Regression
            Mean of the tick's samples.
        residual : (3,) array
            Its residuals, rad/s^2.
        derivatives : (3, 4) array
            Control derivatives that go with them.
        weight : (3,) array
            How much the rows learn from it, 0 ... 1.
        """
        if sample.restarted:
            self._known = 0
        inputs = sample.f[0, INPUT_COLUMNS][self._main]
        self._past[1:] = self._past[:-1].copy()
        self._past[0] = inputs
        self._known += 1
        if self._known <= LAGS:
            return
        bent = (inputs * np.abs(inputs), np.sign(inputs), np.ones(len(ROWS)))
        f = np.vstack((self._past, *bent)).T
        dt = weight * sample.time
        keep = np.exp(-dt / MEMORY)
        weighted = f * dt[:, None]
        self._information *= keep[:, None, None]
        self._information += weighted[:, :, None] * f[:, None, :]
        self._product *= keep[:, None]
        self._product += weighted * residual[:, None]
        self._square = keep * self._square + dt * residual * residual
        self._time = keep * self._time + dt
        self._since_look += sample.time
        if self._since_look >= LOOK_TIME:
            self._since_look = 0.0
            main = derivatives[np.arange(len(ROWS)), self._main]
            self._look(main)

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
