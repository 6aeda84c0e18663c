# SPDX-License-Identifier: Apache-2.0
"""Inputs that act on the axis of another one: exchanged, or seen by an Imu that is turned.

An aircraft is symmetric. Its elevator neither rolls nor yaws it, its ailerons and its rudder do not
pitch it, and the structures have no coefficient for that. With exchanged channels the main control
derivatives are therefore zero, and nothing else shows the effect. Each angular acceleration is
regressed on all inputs instead, beside the rates, a constant, and ay and az for the flow angles.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from uav_ident_ros.identification.regression import Regression, diagonal
from uav_ident_ros.identification.scales import (
    INDEPENDENT_TIME,
    LONG_MEMORY,
    OUTLYING,
    ROUNDING,
    START_TIME,
    SURE,
    TINY,
)
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    LAST_COLUMNS,
    MAIN_COLUMNS,
    MAIN_INPUTS,
    RATE_COLUMNS,
    ROWS,
    FloatArray,
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

    @property
    def _time(self) -> float:
        """Time of the samples, s, fading: the sum of the ones."""
        return self._sums.item(len(REGRESSORS), len(REGRESSORS))

    def add(self, samples: Regression) -> None:
        """Add samples, and renew the effects."""
        signals = np.ones((len(samples.y), len(self._sums)))
        there = [j for j in REGRESSORS if j < samples.f.shape[1]]
        signals[:, : len(there)] = samples.f[:, there]
        signals[:, len(there) : len(REGRESSORS)] = 0.0
        signals[:, -len(ROWS) :] = samples.y[:, : len(ROWS)]
        keep = np.exp(-samples.time / LONG_MEMORY)
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

    def turned(self) -> FloatArray | None:
        """Return the angles about the roll and yaw axes that turn the Imu into place, rad, (2,).

        An angle that is not significant is 0. None if neither is, or before `START_TIME`.

        An Imu turned by the rotation vector -t shows the effect e of an input as ``e - t x e``:
        four effects that a symmetric aircraft does not have. They must agree on t, better than with
        one of them alone, for no aircraft is quite symmetric.
        """
        sigma = self._sigma[[0, 2, 1, 1], [1, 1, 0, 2]]
        least = float(sigma.min())
        if self._time < START_TIME or not np.isfinite(least):  # No input has moved
            return None
        (l_a, l_e, l_r), (m_a, m_e, m_r), (n_a, n_e, n_r) = self._effect
        by_turn = np.array([[0.0, m_e], [-m_e, 0.0], [n_a, -l_a], [n_r, -l_r]])
        weights = least / sigma
        slope, shown = weights[:, None] * by_turn, weights * [l_e, n_e, m_a, m_r]
        if np.square(shown).sum() <= (SURE * least) ** 2:  # Nearly always: no angle is significant
            return None
        information = slope.T @ slope
        if np.linalg.cond(information) > 1.0 / ROUNDING:  # Too few inputs have moved
            return None
        turn = np.linalg.solve(information, slope.T @ shown)
        spread = least * np.sqrt(diagonal(np.linalg.inv(information)))
        significant = np.abs(turn) > SURE * spread
        squares, misfit = np.square(shown), np.square(shown - slope @ turn).sum()
        # One of the effects alone, as of unequal ailerons, must not explain as much.
        agree = misfit < min(OUTLYING * least**2, float(squares.sum() - squares.max()))
        return np.where(significant, turn, 0.0) if significant.any() and agree else None

    def _solve(self) -> None:
        """Solve for the effects and their standard deviations.

        The residuals of `INDEPENDENT_TIME` count as one. Inputs that do not move have no effect.
        """
        k, power = len(self._sums) - len(ROWS), self._sums.diagonal()
        scale = np.divide(1.0, np.sqrt(power[:k]), out=np.zeros(k), where=power[:k] > 0.0)[:, None]
        ff, fy = self._sums[:k, :k], self._sums[:k, k:]
        matrix = ff * (scale * scale.T)
        diagonal(matrix)[...] += ROUNDING
        inverse = np.linalg.inv(matrix)
        solved = scale * (inverse @ (scale * fy))
        left = power[k:] - np.add.reduce(solved * fy)
        # Each row's mean square, by the degrees of freedom that are left
        square = np.maximum(left, TINY) / self._time * self._samples / (self._samples - k)
        spread = diagonal(inverse)[MAINS] * scale[MAINS, 0] ** 2 * INDEPENDENT_TIME
        spread[power[MAINS] == 0.0] = np.inf
        self._effect, self._sigma = solved[MAINS].T, np.sqrt(square[:, None] * spread)
