# SPDX-License-Identifier: Apache-2.0
"""Inputs that are exchanged: each acts on the axis of another one.

An aircraft is symmetric. Its elevator neither rolls nor yaws it, its ailerons and its rudder do not
pitch it, and the structures have no coefficient for that. With exchanged channels the main control
derivatives are therefore zero, and nothing else shows the effect. Each angular acceleration is
regressed on all inputs instead, beside the rates, a constant, and ay and az for the flow angles.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.scales import INDEPENDENT_TIME, MEMORY, ROUNDING, TINY
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    LAST_COLUMNS,
    MAIN_COLUMNS,
    MAIN_INPUTS,
    RATE_COLUMNS,
    ROWS,
)

REGRESSORS = np.r_[RATE_COLUMNS, INPUT_COLUMNS, LAST_COLUMNS].tolist()
"""Columns of the rates, of the inputs, and of ay and az, which a structure may not have."""

MAINS = [REGRESSORS.index(j) for j in MAIN_COLUMNS.tolist()]
"""Places of the main inputs of the moment rows among these."""


class ExchangedInputs:
    """Effects of the main input of each moment row on all of these rows."""

    def __init__(self) -> None:
        k = len(REGRESSORS) + 1 + len(ROWS)
        self._sums = np.zeros((k, k))  # Fading, of the products of regressors, 1 and y, times dt
        self._samples = 0.0  # Their number, fading
        # Effect of each main input on each row, and its standard deviation, (rows, inputs)
        self._effect, self._sigma = np.zeros((2, len(ROWS), len(MAINS)))

    def add(self, samples: Regression) -> None:
        """Add samples, and renew the effects."""
        signals = np.ones((len(samples.y), len(self._sums)))
        there = [j for j in REGRESSORS if j < samples.f.shape[1]]
        signals[:, : len(there)] = samples.f[:, there]
        signals[:, len(there) : len(REGRESSORS)] = 0.0
        signals[:, -len(ROWS) :] = samples.y[:, : len(ROWS)]
        keep = np.exp(-samples.time / MEMORY)
        self._sums = keep * self._sums + samples.dt * signals.T @ signals
        self._samples = keep * self._samples + len(signals)
        if self._samples > len(self._sums):
            self._solve()

    def found(self, sure: float) -> list[tuple[str, str]]:
        """Return which inputs act as which others, by name, significantly; none if all are right.

        An input takes the place of another one if it turns the aircraft more about that axis. Only
        a closed exchange counts: an input without effect leaves its place to any other. The rows
        are independent evidence: together they have the significance level `sure`.
        """
        size, rows = np.abs(self._effect), np.arange(len(ROWS))
        acts = size.argmax(axis=1)
        if acts.tolist() == rows.tolist():  # nearly always
            return []
        by = size[rows, acts] - size[rows, rows]
        spread = np.hypot(self._sigma[rows, acts], self._sigma[rows, rows])
        names = [MAIN_INPUTS[row] for row in ROWS]
        for count in range(2, len(ROWS) + 1):
            sigmas = -NormalDist().inv_cdf(NormalDist().cdf(-sure) ** (1.0 / count))
            exchanged = rows[by > (sigmas * spread if sigmas > 0.0 else 0.0)]
            if sorted(acts[exchanged].tolist()) == exchanged.tolist() and len(exchanged) == count:
                return [(names[acts[i]], names[i]) for i in exchanged.tolist()]
        return []

    def _solve(self) -> None:
        """Solve for the effects and their standard deviations.

        The residuals of `INDEPENDENT_TIME` count as one. Inputs that do not move have no effect.
        """
        k = len(self._sums) - len(ROWS)
        power, squares = np.split(np.diagonal(self._sums), [k])
        time, moved = power[-1], power > 0.0
        scale = np.where(moved, 1.0 / np.sqrt(np.where(moved, power, 1.0)), 0.0)
        ff, fy = self._sums[:k, :k], self._sums[:k, k:]
        inverse = np.linalg.inv(ff * np.outer(scale, scale) + ROUNDING * np.eye(k))
        solved = scale[:, None] * (inverse @ (scale[:, None] * fy))
        left = squares - (solved * fy).sum(axis=0)
        # Each row's mean square, by the degrees of freedom that are left
        square = np.maximum(left, TINY) / time * self._samples / (self._samples - k)
        spread = np.where(moved, np.diagonal(inverse) * scale**2 * INDEPENDENT_TIME, np.inf)[MAINS]
        self._effect, self._sigma = solved[MAINS].T, np.sqrt(np.outer(square, spread))
