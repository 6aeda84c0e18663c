# SPDX-License-Identifier: Apache-2.0
"""Whether the flight still confirms what each surface does.

A sequential probability ratio test (Wald 1945) a control derivative: does the whitened residual
look more as if the surface did what is believed, or as if it did nothing? A surface that is lost or
reversed speaks against it as soon as it moves, one that does not move says nothing, and what was
confirmed fades.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.noise import NoiseModel, Whitener
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    MAIN_INPUTS,
    ROWS,
    FloatArray,
)

CONFIRMED = 4.6
"""Logarithm of the odds, a hundred to one, from which on a derivative counts as confirmed."""

LARGEST_ODDS = 2.0 * CONFIRMED
"""Logarithm of the odds beyond which more evidence adds nothing: what has failed is noticed
soon, however long it had worked."""

LEAST_VARIANCE = 1e-12
"""Variance of an innovation below which there is no noise, rad^2/s^4."""


class Confirmation:
    """Evidence for and against the control derivatives of the moment rows."""

    def __init__(self) -> None:
        self._noise = NoiseModel(len(ROWS))
        self._residual = Whitener((len(ROWS),))
        self._inputs = Whitener((len(ROWS), len(INPUTS)))
        self._odds: FloatArray = np.zeros((len(ROWS), len(INPUTS)))
        self._main = [INPUTS.index(MAIN_INPUTS[row]) for row in ROWS]

    def forget(self, row: int) -> None:
        """Forget the evidence of a row: its derivatives are learned anew."""
        self._odds[row] = 0.0

    def add(
        self, sample: Regression, residual: FloatArray, derivatives: FloatArray, max_age: float
    ) -> None:
        """Weigh one tick.

        Parameters
        ----------
        sample : Regression
            Mean of the tick's samples.
        residual : (3,) array
            Its residuals, rad/s^2.
        derivatives : (3, 4) array
            Control derivatives that go with them.
        max_age : float
            Time in which what was confirmed fades while the input does not move, s; 0 for never.
        """
        if sample.restarted:
            for part in (self._noise, self._residual, self._inputs):
                part.restart()
        self._noise.add(residual, sample.time)
        white = self._residual.apply(residual, self._noise)
        inputs = np.broadcast_to(sample.f[0, INPUT_COLUMNS], derivatives.shape)
        moved = self._inputs.apply(inputs, self._noise)
        if white is None or moved is None:
            return
        effect = derivatives * moved
        # Squared residual if the input did nothing, less the squared residual as it is.
        gain = effect * (2.0 * white[:, None] + effect)
        variance = np.maximum(self._noise.variance, LEAST_VARIANCE)[:, None]
        if max_age > 0.0:
            # From the largest odds to those that confirm in just this time.
            self._odds *= (CONFIRMED / LARGEST_ODDS) ** (sample.time / max_age)
        self._odds += 0.5 * gain / variance
        np.clip(self._odds, -LARGEST_ODDS, LARGEST_ODDS, out=self._odds)

    def doubt(self, row: int) -> str:
        """Return why the main control derivative of a row is in doubt; empty if it is not."""
        odds = float(self._odds[row, self._main[row]])
        if odds >= CONFIRMED:
            return ""
        surface = MAIN_INPUTS[ROWS[row]]
        if odds <= -CONFIRMED:
            return f"{ROWS[row]} does not follow {surface} as {ROWS[row]}/{surface} says"
        return f"{ROWS[row]}/{surface} is unconfirmed: {surface} has hardly moved of late"
