# SPDX-License-Identifier: Apache-2.0
"""Whether the flight still confirms what each surface does.

A sequential probability ratio test (Wald 1945) a control derivative: does the whitened residual
look more as if the surface did what is believed, or as if it did nothing? A surface that is lost or
reversed speaks against it as soon as it moves, one that does not move says nothing, and what was
confirmed fades.
"""

from __future__ import annotations

import math

import numpy as np

from uav_ident_ros.identification.regression import RowSamples
from uav_ident_ros.identification.structure import (
    MAIN_INPUTS,
    ROWS,
    FloatArray,
)

CONFIRMED = math.log(100.0)
"""Logarithm of the odds, a hundred to one, from which on a derivative counts as confirmed."""

LARGEST_ODDS = 2.0 * CONFIRMED
"""Logarithm of the odds beyond which more evidence adds nothing: what has failed is noticed
soon, however long it had worked."""

NO_VARIANCE = float(np.finfo(float).eps)
"""Variance, rad^2/s^4, below which a residual has none."""


class Confirmation:
    """Evidence for and against the main control derivatives of the moment rows."""

    def __init__(self) -> None:
        self._odds = [0.0] * len(ROWS)

    def forget(self, row: int) -> None:
        """Forget the evidence of a row: its derivatives are learned anew."""
        self._odds[row] = 0.0

    def add(
        self, white: RowSamples, effect: FloatArray, variance: FloatArray, max_age: float
    ) -> None:
        """Weigh whitened samples.

        Parameters
        ----------
        white : RowSamples
            The samples.
        effect : (3, m) array
            What the main input of each row makes in them, by the derivatives believed.
        variance : (rows,) array
            Variance of their residuals, the innovations.
        max_age : float
            Time in which what was confirmed fades while the input does not move, s; 0 for never.
        """
        # Squared residual if the input did nothing, less the squared residual as it is.
        gain = np.add.reduce(effect * (2.0 * white.residual[: len(ROWS)] + effect), axis=1)
        keep = 1.0
        if max_age > 0.0:
            # From the largest odds to those that confirm in just this time.
            keep = (CONFIRMED / LARGEST_ODDS) ** (effect.shape[1] * white.dt / max_age)
        for i, (more, spread) in enumerate(zip(gain.tolist(), variance.tolist(), strict=False)):
            odds = keep * self._odds[i] + 0.5 * more / max(spread, NO_VARIANCE)
            self._odds[i] = max(min(odds, LARGEST_ODDS), -LARGEST_ODDS)

    def doubt(self, row: int) -> str:
        """Return why the main control derivative of a row is in doubt; empty if it is not."""
        odds = self._odds[row]
        if odds >= CONFIRMED:
            return ""
        surface = MAIN_INPUTS[ROWS[row]]
        if odds <= -CONFIRMED:
            return f"{ROWS[row]} does not follow {surface} as {ROWS[row]}/{surface} says"
        return f"{ROWS[row]}/{surface} is unconfirmed: {surface} has hardly moved of late"
