# SPDX-License-Identifier: Apache-2.0
"""Transport delay of the inputs, estimated from the flight itself.

A bank of delays: for each, the equation ``y = A f`` is solved by least squares with the inputs
that much later, and the one with the smallest residual is right. A delayed input through a
filter is the filtered input, delayed: one filter and a memory serve the whole bank, and the
part of the information that does not depend on the delay is shared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.regression import StateVariableFilter
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    RATE_COLUMNS,
    STRUCTURES,
    FloatArray,
)

LARGEST_DELAY = 0.3
"""Longest delay of the bank, s."""

STEP = 0.01
"""Step of the bank, s; the minimum is interpolated between steps."""

CUTOFF = 25.0
"""Cut-off of the bank's filter, rad/s: above the estimator's, since it is the fast part of the
response that tells a delay from a slower aircraft."""

SETTLING = 8.0
"""Time in which the filter forgets its start, in units of 1 / cut-off."""

SAMPLE_TIME = 0.01
"""Filtered signals are taken this often, s: at the cut-off above, more adds nothing."""

CHUNK_TIME = 1.0
"""The bank is evaluated this often, s. Scores of chunks count as independent."""

MEMORY_TIME = 120.0
"""Time constant of forgetting, s: a delay does not change, but a flight condition does."""

WIDEST_CELL = 0.1
"""Width of the cells from which a bank has too few delays to find a minimum among them, s."""

SHORTEST_RECORD = 10.0
"""Learning time before which no delay is believed, s."""

NEIGHBOURHOOD = 0.06
"""Distance at which a wrong delay must show in the residual, s."""

SURE_SIGMA = 0.008
"""Standard deviation below which the delay counts as known, s."""

SURE_DROP = 0.1
"""Relative drop of the residual variance, against both delays `NEIGHBOURHOOD` away, from
which the delay counts as known."""

RATE_LAGS = (0.05, 0.1, 0.2)
"""Delays of the rates that stand for what an autopilot's answers are made of, s."""

SURE_NOVELTY = 0.1
"""Relative drop of the residual variance, when the inputs join the rates and their past, from
which the inputs are more than an autopilot's answers to gusts. Such answers tell of the autopilot:
they reach 0.05 where nothing excites, excitation 0.2 and more."""

SYSTEMATIC_ERROR = 0.002
"""What no formula sees: gyro noise in the regressors makes the delay come out a little low (1 to
4 ms on flights of known delay), s. Gusts do the same, and more: 4 ms at 0.3 rad/s^2, 10 ms in
moderate turbulence, half of 60 ms where gusts of 1 rad/s^2 move the aircraft as much as its
surfaces do. Least squares takes a gust's decay for the aircraft's."""

SMALLEST_MOVE = 0.005
"""The delay in use moves by no less than this, s: the fit is flat about the right one."""

AGREEING_ESTIMATES = 3
"""So many estimates in a row must ask for another delay before it is used."""

SAME_INTERVAL = 0.01
"""Relative change of the sample interval up to which a bank keeps what it has learned."""

KEPT_WEIGHT = 0.02
"""What was learned with another delay counts for so much: it is biased, by tens of percent for
60 ms, but holds the coefficients until there are new data."""

_RIDGE = 1e-9
_STRUCTURE = STRUCTURES["augmented"]
_INPUTS = np.arange(INPUT_COLUMNS.start, INPUT_COLUMNS.stop)
_RATES = RATE_COLUMNS  # also within the shared columns, which begin alike
_SHARED = np.setdiff1d(np.arange(_STRUCTURE.size), _INPUTS)


@dataclass(frozen=True)
class DelayEstimate:
    """What the flight says about the delay.

    Parameters
    ----------
    delay : float
        Best delay, s.
    sigma : float
        Its standard deviation, s; inf while there is none.
    drop : float
        By how much the residual variance (the product of the three rows') is below that at
        the delays `NEIGHBOURHOOD` away, relative, the smaller of the two; 0 if the flight does
        not tell delays apart.
    novelty : float
        By how much the residual variance falls when the inputs are added to the rates and their
        past, relative; 0 if the inputs are a function of the rates.
    confidence : str
        ``none`` (no data), ``low`` or ``sure``.
    """

    delay: float
    sigma: float
    drop: float
    novelty: float
    confidence: str


NO_ESTIMATE = DelayEstimate(0.0, math.inf, 0.0, 0.0, "none")


class DelayBank:
    """Least squares at every delay of the bank.

    Parameters
    ----------
    h : float
        Width of the cells, s.
    lever_arm : (3,) array
        Position of the accelerometer from the centre of gravity, m, FRD.

    Attributes
    ----------
    delays : (J,) array
        The delays, s.
    residual : (J, 3) array
        Residual sum of squares of pdot, qdot, rdot at each delay, as of the last evaluation; zero
        before.
    estimate : DelayEstimate
        Outcome of the last evaluation.
    """

    def __init__(self, h: float, lever_arm: FloatArray) -> None:
        self._filter = StateVariableFilter(_STRUCTURE, CUTOFF, h, lever_arm)
        self.h = h
        stride = max(1, round(STEP / h))
        self._lags = np.arange(0, round(LARGEST_DELAY / h) + 1, stride)
        self.delays: FloatArray = self._lags * h
        self._every = max(1, round(SAMPLE_TIME / h))
        self._chunk = max(1, round(CHUNK_TIME / h))
        self._rate_lags = np.array([round(lag / h) for lag in RATE_LAGS])
        count, common = len(self._lags), len(_SHARED) + 3 + 3 * len(RATE_LAGS)
        # Columns: the shared regressors, the accelerations, the rates' past.
        self._common: FloatArray = np.zeros((common, common))
        self._cross: FloatArray = np.zeros((count, common, 4))
        self._own: FloatArray = np.zeros((count, 4, 4))
        self._weight = 0.0
        self._score = self._score_squared = self._scores = 0.0
        self._signals: list[FloatArray] = []
        self._length = 0
        self.residual: FloatArray = np.zeros((count, 3))
        self.estimate = NO_ESTIMATE
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; what was learned stays."""
        self._signals.clear()
        self._length = 0
        self._history: FloatArray = np.zeros((int(self._lags[-1]), 18))
        # The filters' start-up differs between the delays until it has died away.
        self._settling = len(self._history) + round(SETTLING / CUTOFF / self.h)

    def add(self, block: Block) -> bool:
        """Take the signals of a block; say whether the bank was evaluated.

        Parameters
        ----------
        block : Block
            Signals, with the inputs not delayed.
        """
        assert block.u_undelayed is not None
        if block.restarted:
            self.restart()
        data = self._filter.apply(replace(block, u=block.u_undelayed), block.x)
        self._signals.append(np.hstack([data.f[:, _SHARED], data.y, data.f[:, _INPUTS]]))
        self._length += len(data.y)
        if self._length < self._chunk:
            return False
        self._absorb(np.concatenate(self._signals))
        self._signals.clear()
        self._length = 0
        return True

    def _absorb(self, signals: FloatArray) -> None:
        before = len(self._history)
        signals = np.concatenate([self._history, signals])
        self._history = signals[-before:]
        new = len(signals) - before
        first = min(self._settling, new)
        self._settling -= first
        ends = np.arange(before + first, len(signals), self._every)
        if not len(ends):
            return
        past = [signals[ends - lag, _RATES] for lag in self._rate_lags]
        common = np.hstack([signals[ends, :-4], *past])
        delayed = signals[ends - self._lags[:, None], -4:]
        keep = math.exp(-new * self.h / MEMORY_TIME)
        self._common = keep * self._common + common.T @ common
        self._cross = keep * self._cross + common.T @ delayed
        self._own = keep * self._own + delayed.transpose(0, 2, 1) @ delayed
        self._weight = keep * self._weight + len(ends)
        self._evaluate(common, delayed, keep)

    def _solve(self) -> tuple[FloatArray, FloatArray]:
        """Coefficients (J, 3, n) and residual sums of squares (J, 3) of all J delays."""
        shared, count = len(_SHARED), len(self._lags)
        coefficients = np.zeros((count, 3, shared + 4))
        residual = np.empty((count, 3))
        for i, mask in enumerate(_STRUCTURE.mask):
            rows = np.flatnonzero(mask[_SHARED])
            own = np.flatnonzero(mask[_INPUTS])
            k = len(rows)
            matrix = np.empty((count, k + len(own), k + len(own)))
            matrix[:, :k, :k] = self._common[np.ix_(rows, rows)]
            matrix[:, :k, k:] = self._cross[:, rows[:, None], own]
            matrix[:, k:, :k] = matrix[:, :k, k:].transpose(0, 2, 1)
            matrix[:, k:, k:] = self._own[:, own[:, None], own]
            vector = np.empty((count, k + len(own)))
            vector[:, :k] = self._common[rows, shared + i]
            vector[:, k:] = self._cross[:, shared + i, own]
            diagonal = np.einsum("ijj->ij", matrix)
            diagonal += _RIDGE * diagonal
            diagonal[diagonal == 0.0] = 1.0
            a = np.linalg.solve(matrix, vector[:, :, None])[:, :, 0]
            coefficients[:, i, np.concatenate([rows, shared + own])] = a
            total = self._common[shared + i, shared + i]
            residual[:, i] = np.maximum(total - (a * vector).sum(axis=1), _RIDGE * total)
        return coefficients, residual

    def _evaluate(self, common: FloatArray, delayed: FloatArray, keep: float) -> None:
        """Find the best delay and say how sure it is."""
        coefficients, residual = self._solve()
        if not residual.all():
            return  # a rate that has never moved
        self.residual = residual
        # Negative log-likelihood with the noise of each row unknown.
        cost = 0.5 * self._weight * np.log(residual).sum(axis=1)
        best = int(np.argmin(cost))
        middle = min(max(best, 1), len(cost) - 2)
        around = slice(middle - 1, middle + 2)
        step = float(self.delays[1])
        # About the minimum it is the residual, not its logarithm, that is a parabola.
        low, here, high = (0.5 * self._weight * residual[around] / residual[best]).sum(axis=1)
        curvature = float(low - 2.0 * here + high) / step**2
        self._add_score(common, delayed, coefficients, residual[best], middle, keep)
        if curvature <= 0.0:
            self.estimate = DelayEstimate(float(self.delays[best]), math.inf, 0.0, 0.0, "low")
            return
        delay = float(self.delays[middle]) - 0.5 * float(high - low) / step / curvature
        delay = min(max(delay, 0.0), float(self.delays[-1]))
        spread = self._score_squared - self._score**2 / max(self._scores, 1.0)
        sigma = math.hypot(math.sqrt(max(spread, 0.0)) / curvature, SYSTEMATIC_ERROR)
        drop, novelty = self._drop(cost, best), self._novelty(best)
        time = self._weight * self._every * self.h
        sure = time >= SHORTEST_RECORD and sigma <= SURE_SIGMA
        sure = sure and drop >= SURE_DROP and novelty >= SURE_NOVELTY
        self.estimate = DelayEstimate(delay, sigma, drop, novelty, "sure" if sure else "low")

    def _add_score(
        self,
        common: FloatArray,
        delayed: FloatArray,
        coefficients: FloatArray,
        residual: FloatArray,
        middle: int,
        keep: float,
    ) -> None:
        """Add the chunk's slope of the cost about the delay in the `middle`."""
        shared = len(_SHARED)
        squares = []
        for j in (middle - 1, middle + 1):
            a = coefficients[j]
            e = common[:, shared : shared + 3] - common[:, :shared] @ a[:, :shared].T
            e -= delayed[j] @ a[:, shared:].T
            squares.append((e**2).sum(axis=0))
        slope = (squares[1] - squares[0]) / (2.0 * self.delays[1])
        score = float((0.5 * self._weight * slope / residual).sum())
        self._score = keep * self._score + score
        self._score_squared = keep**2 * self._score_squared + score**2
        self._scores = keep * self._scores + 1.0

    def _drop(self, cost: FloatArray, best: int) -> float:
        away = round(NEIGHBOURHOOD / float(self.delays[1]))
        sides = [cost[j] for j in (best - away, best + away) if 0 <= j < len(cost)]
        # The longest delay of the bank stands for all longer ones: it is no minimum.
        rise = min(sides) - cost[best] if best < len(cost) - 1 else 0.0
        return float(-math.expm1(-2.0 * rise / self._weight))

    def _novelty(self, best: int) -> float:
        """Share of the residual that the inputs explain and the rates' past does not."""
        shared = len(_SHARED)
        past = np.arange(shared + 3, len(self._common))
        moments = np.block(
            [[self._common, self._cross[best]], [self._cross[best].T, self._own[best]]]
        )
        left = 1.0
        for i, mask in enumerate(_STRUCTURE.mask):
            without = np.concatenate([np.flatnonzero(mask[_SHARED]), past])
            inputs = len(self._common) + np.flatnonzero(mask[_INPUTS])
            y = shared + i
            with_inputs = _residual(moments, np.concatenate([without, inputs]), y)
            left *= with_inputs / _residual(moments, without, y)
        return float(1.0 - left)


def _residual(moments: FloatArray, columns: NDArray[np.intp], y: int) -> float:
    """Residual sum of squares of regressing column `y` on `columns`, from the moments."""
    matrix, vector = moments[np.ix_(columns, columns)], moments[columns, y]
    diagonal = np.einsum("ii->i", matrix)
    diagonal += _RIDGE * diagonal
    diagonal[diagonal == 0.0] = 1.0
    total = float(moments[y, y])
    return max(total - float(vector @ np.linalg.solve(matrix, vector)), _RIDGE * total)


class DelayTracker:
    """The delay in use, moved when the bank is sure of another.

    Parameters
    ----------
    delay : float
        Delay to start with, s.
    lever_arm : (3,) array
        Position of the accelerometer from the centre of gravity, m, FRD.

    Attributes
    ----------
    delay : float
        Delay in use, s.
    """

    def __init__(self, delay: float, lever_arm: FloatArray) -> None:
        self.delay = delay
        self._arm = lever_arm
        self._bank: DelayBank | None = None
        self._agreeing = 0

    @property
    def estimate(self) -> DelayEstimate:
        """What the flight says."""
        return NO_ESTIMATE if self._bank is None else self._bank.estimate

    def add(self, block: Block) -> bool:
        """Learn from a block; say whether the delay in use has moved."""
        if block.h > WIDEST_CELL:
            return False
        if self._bank is None or abs(block.h / self._bank.h - 1.0) > SAME_INTERVAL:
            self._bank = DelayBank(block.h, self._arm)
        if not self._bank.add(block):
            return False
        found = self._bank.estimate
        apart = abs(found.delay - self.delay) > max(SMALLEST_MOVE, 2.0 * found.sigma)
        self._agreeing = self._agreeing + 1 if apart and found.confidence == "sure" else 0
        if self._agreeing < AGREEING_ESTIMATES:
            return False
        self._agreeing = 0
        self.delay = found.delay
        return True
