# SPDX-License-Identifier: Apache-2.0
"""Noticing that a control derivative has changed, from the residuals alone.

Forgetting cannot follow a surface that loses half its effect: fast enough for that, it lets
everything else wander. So the residuals of the last seconds, whitened since gusts are slow, are
searched for a slope along each input, and only the coefficient that changed is released.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.scales import INDEPENDENT_TIME, LOOK_TIME, MEMORY
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    INPUTS,
    BoolArray,
    FloatArray,
)

WINDOW_TIME = 5.0
"""Time over which the slope is taken, s."""

CONFIRMATIONS = 4
"""Looks in a row that must agree."""

MIN_T = 4.5
"""Slope in standard deviations below which nothing has changed."""

MIN_CHANGE = 0.2
"""Slope relative to the coefficient below which a change does not matter."""

MIN_HISTORY_RATIO = 3.5
"""Slope relative to its own usual size: model errors give slopes that come and go."""

HISTORY_DELAY = 10.0
"""Newest stretch that the usual size leaves out, s: a change has so long to be noticed before it
becomes usual itself."""

SHORTEST_HISTORY = 3.0
"""Time after which there is a usual size, s: with the window and the delay, 18 s of learning."""

LEARNED_SIGMAS = 2.0
"""Slope in standard deviations of the coefficient itself up to which it is being learned, not
changed."""

MIN_EXPLAINED = 0.33
"""Share of a row's whitened residual that the slope explains below which nothing has changed."""

MIN_EXPLAINED_UNCLEAR = 0.42
"""The same where the inputs do not stand out from all else that moves the aircraft: the answers of
an autopilot to a storm explain up to 0.4."""

LIVELY_SHARE = 0.25
"""Variance of an input, relative to its mean while learning, below which it shows no change."""

LARGEST_CORRELATION = 0.9
"""Correlation of the residuals from sample to sample up to which they are whitened: beyond it, what
is left of a slow input would be noise."""

FEWEST_SAMPLES = 3
"""Samples from which a slope can be told at all: a slow Imu has few in the window."""

SURFACES = np.array([label != "dth" for label in INPUTS])
"""Which of the inputs are control surfaces."""


PASSED = 6.0
"""Time in which a step passes the regression's filter, to 2 %, times its cut-off."""

CONSTANT = len(INPUTS)
"""Place of the constant behind the inputs."""


@dataclass(frozen=True)
class Step:
    """A step of a row's constant, from the residuals of a window."""

    size: float
    explained: float  # Share of the row's whitened residual that it explains, 0 ... 1
    samples: int  # How many samples ago it had passed the filter


@dataclass(frozen=True)
class Slopes:
    """How much each control derivative seems to have changed, from the residuals of a window."""

    # slope, deviation: (3, 4) Slope of the residual along each input, and its standard deviation,
    # by the long-run variance
    slope: FloatArray
    deviation: FloatArray
    t: FloatArray  # (3, 4) Their ratio
    # (3, 4) Share of the row's whitened residual that the slope explains, 0 ... 1.
    explained: FloatArray
    power: FloatArray  # (4,) Integral of each input's square over the window, about its mean


class ChangeDetector:
    """Watches the residuals for a changed control derivative.

    Parameters
    ----------
    free : (3, n) bool array
        Coefficients that move.
    cutoff : float
        Of the regression's filter, rad/s.

    Attributes
    ----------
    found : Slopes
        What the last look found.
    """

    def __init__(self, free: BoolArray, cutoff: float) -> None:
        self._cutoff = cutoff
        # Throttle acts through the propeller's speed: its column has no single true value.
        self._row, self._input = np.nonzero(free[:, INPUT_COLUMNS] & SURFACES)
        constants = free[:, CONSTANT_COLUMN : CONSTANT_COLUMN + 1]
        self._has_constant: BoolArray = constants.any(axis=1)
        self._residual: FloatArray = np.zeros((0, 3))
        self._rho: FloatArray = np.zeros(3)
        # Of what came: (time, samples) of the window, and y and f, joined at each look
        self._window: deque[tuple[float, int]] = deque()
        self._y: list[FloatArray] = []
        self._f: list[FloatArray] = []
        self._count = 0
        self._dt = 0.0
        nothing = np.zeros((3, 4))
        self.found = Slopes(nothing, nothing, nothing, nothing, np.zeros(4))
        self._recent_time = 0.0
        self._since_look = 0.0
        self._usual: FloatArray = np.zeros((3, 4))  # times power
        self._usual_power: FloatArray = np.zeros((3, 4))
        self._usual_time = 0.0
        self._newest: deque[tuple[float, FloatArray, FloatArray]] = deque()
        self._newest_time = 0.0
        self._square: FloatArray = np.zeros(3)
        self._product: FloatArray = np.zeros(3)
        self._agreeing = np.zeros((3, 4), dtype=np.int64)
        self._hold_off: FloatArray = np.full(3, WINDOW_TIME)

    def restart(self) -> None:
        """Forget the window: what comes does not continue it."""
        self._window.clear()
        self._y, self._f = [], []
        self._count = 0
        self._recent_time = self._since_look = 0.0
        self._agreeing.fill(0)

    def add(self, samples: Regression) -> bool:
        """Take new samples; say whether it is time to look at them."""
        if samples.restarted:
            self.restart()
        self._y.append(samples.y[:, :3])
        self._f.append(samples.f)
        self._window.append((samples.time, len(samples.y)))
        self._dt = samples.dt
        self._count += len(samples.y)
        self._recent_time += samples.time
        while self._recent_time > WINDOW_TIME:
            time, count = self._window.popleft()
            self._recent_time -= time
            self._count -= count
        self._since_look += samples.time
        if self._since_look < LOOK_TIME - 0.5 * samples.dt:
            return False
        if self._recent_time < WINDOW_TIME - 1.5 * samples.time:
            return False
        return self._count >= FEWEST_SAMPLES

    def look(
        self, coefficients: FloatArray, sigma: FloatArray, lively: BoolArray, clear: BoolArray
    ) -> list[tuple[int, int]]:
        """Return (row, input) of each control derivative that has changed.

        A motor that loses thrust steps a constant moment, and the controller answers with a step of
        its inputs, which looks like a slope. Where the step of the constant explains more, the
        place is `CONSTANT`.

        Parameters
        ----------
        coefficients : (3, n) array
            The estimate: whitened, as the residuals are.
        sigma : (3, 4) array
            Standard deviations of its control derivatives.
        lively : (4,) bool array
            Inputs that move enough to tell.
        clear : (3,) bool array
            Rows in which the inputs stand out from all else that moves the aircraft.
        """
        elapsed, self._since_look = self._since_look, 0.0
        self._hold_off = np.maximum(self._hold_off - elapsed, 0.0)
        self.found = found = self._slopes(coefficients)
        size = np.abs(found.slope)
        usual = np.sqrt(_ratio(self._usual, self._usual_power))
        alarm = (
            lively
            & (found.explained >= np.where(clear, MIN_EXPLAINED, MIN_EXPLAINED_UNCLEAR)[:, None])
            & (found.t > MIN_T)
            & (size > MIN_CHANGE * np.abs(coefficients[:, INPUT_COLUMNS]))
            & (size > LEARNED_SIGMAS * sigma)
            & (size > MIN_HISTORY_RATIO * usual)
            & (self._hold_off == 0.0)[:, None]
            & (self._usual_time >= SHORTEST_HISTORY)
        )
        self._agreeing = np.where(alarm, self._agreeing + 1, 0)
        self._remember(np.where(alarm, 0.0, found.power), found.slope**2, elapsed)
        changed = []
        sure = self._agreeing >= CONFIRMATIONS
        for i in np.flatnonzero(sure.any(axis=1)).tolist():
            # One release at a time in a row: the strongest, the others may only mirror it.
            strongest = int(np.where(sure[i], found.t[i], 0.0).argmax())
            stepped = self.step(i).explained > found.explained[i, strongest]
            changed.append((i, CONSTANT if stepped and self._has_constant[i] else strongest))
            self._hold_off[i] = WINDOW_TIME
            self._agreeing[i] = 0
            for _, power, _ in self._newest:
                power[i] = 0.0
        return changed

    def _remember(self, power: FloatArray, square: FloatArray, elapsed: float) -> None:
        """Let what is old enough of the squared slopes count in their usual size.

        Each counts by the power of its input: where an input hardly moves, its slope is noise.
        """
        self._newest.append((elapsed, power, square))
        self._newest_time += elapsed
        while self._newest_time > HISTORY_DELAY:
            time, counts, old = self._newest.popleft()
            self._newest_time -= time
            self._usual_time += time
            keep = np.exp(-time / MEMORY)
            self._usual = keep * self._usual + counts * old
            self._usual_power = keep * self._usual_power + counts

    def _slopes(self, coefficients: FloatArray) -> Slopes:
        """Look for slopes over the window."""
        y, f = (np.concatenate(parts)[-self._count :] for parts in (self._y, self._f))
        self._y, self._f = [y], [f]
        residual = y - f @ coefficients.T
        residual -= np.add.reduce(residual) / len(y)
        u = f[:, INPUT_COLUMNS]
        u = u - np.add.reduce(u) / len(u)
        rho = self._correlation(residual)
        self._residual, self._rho = residual, rho
        white = (residual[1:] - rho * residual[:-1])[:, self._row]
        # One column for each watched coefficient.
        u_white = u[1:, self._input] - rho[self._row] * u[:-1, self._input]
        power = np.add.reduce(u_white * u_white)
        power[power < np.finfo(float).tiny ** 0.5] = np.inf  # a constant input has no slope
        product = np.add.reduce(u_white * white)
        slope = product / power
        deviation = np.sqrt(self._long_run(u_white * (white - slope * u_white))) / power
        t = _ratio(np.abs(slope), deviation)
        explained = _ratio(slope * product, np.add.reduce(white * white))
        placed = np.zeros((4, 3, len(INPUTS)))
        placed[:, self._row, self._input] = slope, deviation, t, explained
        power = np.add.reduce(u * u) * self._dt
        return Slopes(placed[0], placed[1], placed[2], placed[3], power)

    def step(self, row: int) -> Step:
        """Return the step of the constant that explains most of a row's last window."""
        residual, rho = self._residual[:, row], self._rho[row]
        count = len(residual)
        # column k: a step at the start of sample k + 1 as the regression's filter passes it, taken
        # at the middle of each sample
        after = np.maximum(np.arange(count)[:, None] - np.arange(1, count) + 0.5, 0.0)
        phase = self._cutoff * self._dt * after / np.sqrt(2.0)
        steps = 1.0 - np.exp(-phase) * (np.cos(phase) + np.sin(phase))
        steps -= steps.mean(axis=0)
        white, steps = residual[1:] - rho * residual[:-1], steps[1:] - rho * steps[:-1]
        product, power = steps.T @ white, np.add.reduce(steps * steps)
        explained = product * product / power
        best = int(np.argmax(explained))
        share = float(_ratio(explained[best], white @ white))
        passed = round(PASSED / (self._cutoff * self._dt))
        size = float(product[best] / power[best])
        return Step(size, share, max(0, count - 1 - best - passed))

    def _long_run(self, scores: FloatArray) -> FloatArray:
        """Return the variance of the sums of scores of shape (m, k), shape (k,).

        Sums over sliding blocks of the correlation time give the Bartlett estimate.
        """
        count = len(scores)
        sums = np.zeros((count + 1, scores.shape[1]))
        np.add.accumulate(scores, out=sums[1:])
        length = min(max(1, round(INDEPENDENT_TIME / self._dt)), count)
        blocks = sums[length:] - sums[:-length]
        return np.asarray(np.add.reduce(blocks * blocks) * (count / (length * len(blocks))))

    def _correlation(self, residual: FloatArray) -> FloatArray:
        """Return the running correlation of the residuals from sample to sample, shape (3,)."""
        square = np.add.reduce(residual * residual)
        product = np.add.reduce(residual[1:] * residual[:-1])
        keep = np.exp(-LOOK_TIME / MEMORY)
        self._square = keep * self._square + square
        self._product = keep * self._product + product
        return np.clip(_ratio(self._product, self._square), 0.0, LARGEST_CORRELATION)


def _ratio(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a / b, zero where b is not positive."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0.0)
