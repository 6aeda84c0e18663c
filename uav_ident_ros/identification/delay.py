# SPDX-License-Identifier: Apache-2.0
"""Transport delay of the inputs from the flight: the delay whose model predicts best.

A bank of light models, one for each delay and servo lag, learns by least squares and predicts
freely, a second at a time and out of sample. The residual of least squares finds the delay of the
autopilot's answers; prediction finds the aircraft's. Without excitation all delays predict alike.
Quiet flight is therefore left out: an autopilot's answers would in time outweigh the excitation.
Delay and lag predict alike, too: the delay for the lag in use is well determined, the split only in
calm air. An estimate from the response to injected signals takes the bank's place as soon as it is
sure.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from uav_ident_ros.identification.estimators.information import FIRST_RESIDUAL_VARIANCE
from uav_ident_ros.identification.injected_response import Found, InjectedResponse
from uav_ident_ros.identification.model import GRAVITY, LIFT_SLOPE, SIDE_FORCE_SLOPE
from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.prior import FORCE_SIGMA, INPUT_SIGMA, RATE_SIGMA
from uav_ident_ros.identification.residuals import ANSWER_TIMES
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.sampling import Block, join
from uav_ident_ros.identification.scales import BLOCKS, DOUBTLESS, SAMPLE_TIME, STEP
from uav_ident_ros.identification.structure import INPUTS, BoolArray, FloatArray

LAGS = (0.0, 0.06, 0.12)
"""Servo lags of the bank, beyond the one in use, s."""

_LAG_STEPS = math.ceil(4.0 * LAGS[-1] / STEP)  # The response of the longest has decayed by then

WINDOW, WINDOWS = round(HORIZONS[0] / STEP), round(HORIZONS[-1] / HORIZONS[0])
"""Steps of a prediction, 1 s, and predictions of a block: as long as a pilot's prediction."""

SAMPLE = round(2.0 * SAMPLE_TIME / STEP)
"""Steps of integration of the equation of motion for one sample of the regression."""

FEWEST_BLOCKS = 2
"""Number of blocks before predictions count, and of predicted blocks before an estimate."""

RIDGE = FIRST_RESIDUAL_VARIANCE * SAMPLE * STEP
"""Residual variance times its correlation time, the weight of the models' prior, rad^2/s^3."""

ALIKE = 0.08
"""Relative difference of the squared error at which two lags predict alike: two points of a fit of
50 %. Least squares in gusts turns some of a lag into slower damping."""

APART = 3
"""Distance, in steps, at which a wrong delay must predict worse by `DOUBTLESS` standard deviations:
an autopilot's answers alone reach 3.5. The bank extends twice as far below zero delay, since stamps
may be late."""

SYSTEMATIC_ERROR = 0.0075
"""Error that the scatter of blocks does not show, s: noise and gusts in the regressors, held
inputs."""

SURE_SIGMA = 2.0 * SYSTEMATIC_ERROR
"""Standard deviation up to which a delay counts as known, s: a larger error lowers the fit."""

_KEEP = math.exp(-1.0 / BLOCKS)  # Discount factor of the sums, for each block
_RUDDER, _ELEVATOR = INPUTS.index("dr"), INPUTS.index("de")
_SURFACES = (_RUDDER, _ELEVATOR)
# Regressors of the moments: p q r, inputs, constant, ay az.
_INPUTS, _CONSTANT, _FORCES = slice(3, 7), 7, slice(8, 10)
_PRECISION = (
    RIDGE / np.array([RATE_SIGMA] * 3 + [INPUT_SIGMA] * 4 + [RATE_SIGMA] + [FORCE_SIGMA] * 2) ** 2
)
_LEAST_SLOPES = 0.1 * np.array([SIDE_FORCE_SLOPE, LIFT_SLOPE])


def _beyond(error: float, sigma: float) -> float:
    """Return the rms of an error beyond the standard deviation of its estimate."""
    return math.sqrt(max(error**2 - sigma**2, 0.0))


@dataclass(frozen=True)
class DelayEstimate:
    """Estimate of the transport delay and servo lag, with its uncertainty."""

    delay: float = 0.0  # For the lag in use, s; negative where that is too long
    sigma: float = math.inf  # Its standard deviation, s
    total: float = 0.0  # Delay plus lag, for any lag, s
    total_sigma: float = math.inf  # Its standard deviation, s
    rise: float = 0.0  # Of the prediction error at wrong delays, in its standard deviations
    lag: float = 0.0  # First-order lag, s
    lag_sigma: float = math.inf  # Its standard deviation, s
    hidden: float = 0.0  # Lag beyond the one in use, in whose place the delay may be, rms, s

    @property
    def sure(self) -> bool:
        """Whether the delay is known."""
        return self.sigma <= SURE_SIGMA and self.rise >= DOUBTLESS

    @property
    def total_sure(self) -> bool:
        """Whether the sum of delay and lag is known, too."""
        return self.sure and self.total_sigma <= SURE_SIGMA

    @property
    def from_injected(self) -> bool:
        """Whether the estimate is from injected signals, which give the lag a sigma."""
        return math.isfinite(self.lag_sigma)

    @property
    def lag_sure(self) -> bool:
        """Whether the split is known: its random error is at most the systematic one."""
        return self.total_sure and self.lag_sigma <= math.sqrt(2.0) * SYSTEMATIC_ERROR

    @property
    def confidence(self) -> str:
        """Confidence in the delay: ``none`` (no data), ``low`` or ``sure``."""
        return "sure" if self.sure else "low" if math.isfinite(self.sigma) else "none"

    def lag_off(self, lag: float) -> float:
        """Return estimated lag minus lag in use, s; 0 where that is not known to be wrong.

        No lag exceeds the sum: no input acts before it is given.
        """
        off = self.lag - lag
        if self.total_sure and lag - self.total > 2.0 * self.total_sigma:
            return min(off, self.total - lag)
        return off if self.lag_sure and abs(off) > 2.0 * self.lag_sigma else 0.0

    def off(self, delay: float) -> float:
        """Return estimated delay minus delay in use, s; 0 where that is not known to be wrong."""
        off = self.delay - delay
        wrong = self.rise >= DOUBTLESS and abs(off) > 2.0 * self.sigma
        return off if wrong else 0.0

    def beyond(self, delay: float) -> float:
        """Return the rms of a delay's error that a sure estimate shows beyond its own error, s."""
        return _beyond(self.delay - delay, self.sigma) if self.sure else 0.0

    def lag_beyond(self, lag: float) -> float:
        """Return the rms of a lag's error that injected signals show beyond their own error, s."""
        return min(_beyond(self.lag - lag, self.lag_sigma), LAGS[-1])

    def total_beyond(self, total: float) -> float:
        """Return the same of a sum of delay and lag, s."""
        return _beyond(self.total - total, self.total_sigma)

    def contradiction(self, delay: float, held: float = 0.0) -> str:
        """Return a message with the error of a delay in use, s, and its cure.

        Inputs at a low rate are `held` too long, s, and then appear to act early.
        """
        off = self.delay - delay
        word = "later" if off > 0.0 else "earlier"
        cure = f"set 'actuators.delay' to {self.delay:.3f}"
        if self.delay < 0.0:
            cure = "correct their stamps, or lower 'actuators.time_constant'"
        if off < 0.0 and -off <= held:
            cure = (
                f"they come every {2e3 * held:.0f} ms and are held until then: publish them more "
                "often, or set 'actuators.interpolation' to 'linear'"
            )
        return (
            f"the inputs act {1e3 * abs(off):.0f} ms {word} than 'actuators.delay' and "
            f"'actuators.time_constant' say: {cure}"
        )

    def lag_contradiction(self, lag: float, *, configured: bool) -> str:
        """Return a message with the error of a servo lag in use, s, and its cure."""
        if configured:
            delay = max(self.total - self.lag, 0.0)
            return (
                f"the actuators have a lag of {1e3 * self.lag:.0f} ms, not of {1e3 * lag:.0f}: set "
                f"'actuators.time_constant' to {self.lag:.3f} and 'actuators.delay' to {delay:.3f}"
            )
        cure = "excite the aircraft (~/excite)"
        if self.from_injected:
            cure = "go on with the excitation"
        return (
            f"delay and servo lag are not separated: {1e3 * self.hidden:.0f} ms of the delay found "
            f"may be lag; set 'actuators.time_constant', or {cure}"
        )


NO_ESTIMATE = DelayEstimate()


@dataclass(frozen=True)
class _Signals:
    """Signals of a block on the bank's grid: W windows of N steps."""

    x: FloatArray  # Rates at the edges of the steps, (W, N + 1, 3)
    force: FloatArray  # ay and az, means of the steps on both sides, (W, N + 1, 2)
    down: FloatArray  # y and z of the unit vector that points down, (W, N + 1, 2)
    airspeed: float
    u: FloatArray  # Means of the inputs over steps, from the earliest delayed one, (M, 4)
    injected: bool  # Whether the block has injected signals

    @cached_property
    def means(self) -> FloatArray:
        """Means over the samples of rates, a one, and forces, (W, samples, 6)."""
        one = np.ones((*self.x.shape[:2], 1))
        return _means(np.concatenate((self.x, one, self.force), axis=2))

    @cached_property
    def slopes(self) -> FloatArray:
        """Rates of change of rates and forces over the samples, (W, samples, 5)."""
        return _slopes(np.concatenate((self.x, self.force), axis=2))

    @cached_property
    def worst(self) -> FloatArray:
        """Squared errors of a failed prediction of p, q, r, (W, 3)."""
        spread = (self.x - self.x.mean(axis=(0, 1))) ** 2
        return np.asarray(np.maximum(spread.sum(axis=1), spread.sum(axis=(0, 1)) / WINDOWS))

    @cached_property
    def turning(self) -> FloatArray:
        """Rates of sideslip and angle of attack by the kinematics, (W, samples, 2), rad/s."""
        by_force = (self.force + GRAVITY * self.down) / self.airspeed
        return _means(by_force + self.x[..., 2:0:-1] * (-1.0, 1.0))


class DelayBank:
    """Light models, one for each delay and lag, with their prediction errors."""

    def __init__(
        self,
        longest: float,  # Longest plausible delay, s
        lag: float = 0.0,  # Servo lag in use, s
        before: DelayBank | None = None,  # The bank with another lag; its injected response stays
    ) -> None:
        self._lag = lag
        self._back = round(longest / STEP)
        self._early = 2 * APART + math.ceil(lag / STEP)
        self._before_ns = round((self._back + _LAG_STEPS + 1) * STEP / NS)
        self._length_ns = round((WINDOW * WINDOWS + self._early + 1) * STEP / NS)
        self.delays: FloatArray = STEP * np.arange(-self._early, self._back + 1)
        count = len(self.delays)
        self._models = [_Models(count) for _ in LAGS]
        steps = WINDOW * np.arange(WINDOWS)[:, None] + np.arange(-1, WINDOW + 1)
        first = self._back + 1 + self._early - np.arange(count)
        self._pick = first[:, None, None] + steps  # (J, W, N + 2): one more step on both sides
        self._errors: deque[FloatArray] = deque(maxlen=BLOCKS)
        self._power: FloatArray = np.zeros((len(LAGS), len(INPUTS)))  # Of the inputs with each lag
        self._block: Generator[None, None, bool] | None = None
        self._response, self._injected = InjectedResponse(), NO_ESTIMATE
        if before is not None:
            self._response, known = before._response, before._injected
            if known.from_injected:  # The bank's own estimate holds for its blocks alone
                delay, sigma = known.total - lag, known.total_sigma
                self._injected = replace(known, delay=delay, sigma=sigma, hidden=known.lag_sigma)
        self.estimate: DelayEstimate = self._injected
        self._delay_ns = 0
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; the models stay."""
        self._parts: list[tuple[Block, bool]] = []  # And whether each is excited
        self._first: int | None = None
        self._response.restart()

    @property
    def errors(self) -> FloatArray:
        """Squared prediction errors of p, q, r at each delay, with the lag in use, (J, 3).

        Geometric means over blocks, as in the cost.
        """
        if not self._errors:
            return np.zeros((len(self.delays), 3))
        return np.asarray(np.exp(_logarithms(np.stack(self._errors))[:, 0].mean(axis=0)))

    def lost(self, lag: float) -> FloatArray:
        """Return the share of each input, (4,), that a lag, s, in the delay's place removes."""
        share = 1.0 - np.sqrt(self._power / np.maximum(self._power[0], np.finfo(float).tiny))
        share[:, self._power[0] == 0.0] = 0.0
        return np.array([np.interp(lag, LAGS, column) for column in share.T])

    def add(
        self,
        block: Block,  # Without flow, forces are left out
        delay: float,  # Delay of the block's inputs, s
        excited: bool = True,  # Whether more than an autopilot in gusts moves the inputs
    ) -> bool:
        """Add a block; return whether the estimate is new."""
        delay_ns = round(delay / NS)
        edges = block.t_ns
        last_ns = self._parts[-1][0].t_ns[-1] if self._parts else edges[0]
        if last_ns != edges[0] or delay_ns != self._delay_ns:
            self.restart()
        self._delay_ns = delay_ns
        before = max(self._before_ns - delay_ns, round(STEP / NS))  # Forces reach a step back
        if self._first is None:
            self._first = int(edges[0]) + before
        self._parts.append((block, excited))
        renewed = self._work()
        while edges[-1] - max(delay_ns, 0) >= self._first + self._length_ns:
            while self._block is not None:
                renewed = self._work() or renewed
            signals, first = self._signals(self._first), self._first
            self._first += WINDOW * WINDOWS * round(STEP / NS)
            if signals.injected or self._excited(first, self._first):
                self._block = self._judge_models(signals)
            keep = self._first - before - round(STEP / NS)  # Signals are means over a step
            self._parts = [part for part in self._parts if part[0].t_ns[-1] >= keep]
        return renewed

    def _excited(self, first: int, last: int) -> bool:
        """Return whether the flight was excited for most of the time from `first` to `last`, ns."""
        time = sum(
            min(int(block.t_ns[-1]), last) - max(int(block.t_ns[0]), first)
            for block, excited in self._parts
            if excited and block.t_ns[-1] > first and block.t_ns[0] < last
        )
        return 2 * time > last - first

    def _signals(self, first: int) -> _Signals:
        """Resample the collected blocks from `first`, ns, on."""
        block = join([block for block, _ in self._parts])
        self._has_flow, airspeed = block.airspeed is not None, 1.0
        values = np.zeros((len(block.x), 7))
        values[:, :3] = block.x
        if block.airspeed is not None:
            airspeed = block.airspeed
            values[:, 3:5], values[:, 5:] = block.force, block.state[:, 6:]
        t, u = (block.t_ns - first) * NS, block.u
        if block.excitation is not None:
            u = np.concatenate((u, block.excitation), axis=1)
        values, u = _smoothed(values, block.h), _smoothed(u, block.h)
        grid = STEP * np.arange(WINDOW * WINDOWS + 1)
        signals = _interpolate(grid, t, values)
        # A step of a surface is a step of the force: both are means over the same time.
        force = 0.5 * (values[1:, 3:5] + values[:-1, 3:5])
        if block.by_turning is not None:
            force -= _smoothed(block.by_turning, block.h)
        ends = STEP * np.arange(-1, WINDOW * WINDOWS + 2)
        sums = _interpolate(ends, t, _integral(force, t))
        signals[:, 3:5] = (sums[2:] - sums[:-2]) / (2.0 * STEP)
        added = _integral(u, t)
        before = self._back + _LAG_STEPS + 1
        grid = STEP * np.arange(-before, WINDOW * WINDOWS + self._early + 2)
        means = np.diff(_interpolate(grid, t - self._delay_ns * NS, added), axis=0) / STEP
        places = WINDOW * np.arange(WINDOWS)[:, None] + np.arange(WINDOW + 1)
        x, force, down = np.split(signals[places], [3, 5], axis=2)
        means, injected = np.split(means, [len(INPUTS)], axis=1)
        if injected.size:
            own = slice(before, before + WINDOW * WINDOWS)
            self._response.add(signals[:, :5], means[own], injected[own], self._lag)
        return _Signals(x, force, down, airspeed, means, bool(injected.any()))

    def _work(self) -> bool:
        """Do the next part of the work on a block; return whether the estimate is new."""
        if self._block is None:
            return False
        try:
            next(self._block)
        except StopIteration as done:
            self._block = None
            return bool(done.value)
        return False

    def _judge_models(self, signals: _Signals) -> Generator[None, None, bool]:
        """Score and update the models with each lag by a block, in steps; then estimate."""
        self._power *= _KEEP
        scores = []
        for power, lag, models in zip(self._power, LAGS, self._models, strict=True):
            u = _lagged(signals.u, lag)
            power += u.var(axis=0)
            scores.append(models.score(signals, u[self._pick]))
            yield
            models.learn(signals, u, self._pick[..., 1:-1:SAMPLE])
            yield
        if signals.injected and self._response.windows > 2 * FEWEST_BLOCKS:
            found = yield from self._response.find(self.delays, LAGS, APART * STEP)
            at_lag = yield from self._response.find(self.delays, (self._lag,), APART * STEP)
            if found is not None and at_lag is not None:
                self._injected = by_injection(found, at_lag, self._lag)
        errors = [e for e in scores if e is not None]  # No score before the first updates
        if not errors:
            return False
        self._errors.append(np.stack(errors))
        if len(self._errors) >= FEWEST_BLOCKS:
            opposed = False if self._has_flow else self._models[0].opposed(self._early)
            bank = judge(np.stack(self._errors), self.delays, self._lag, opposed)
            if self._response.windows > 0.0:  # The sum then waits for the injected response
                bank = replace(bank, total_sigma=max(bank.total_sigma, self._injected.total_sigma))
            self.estimate = self._injected if self._injected.total_sure else bank
        return True


class _Models:
    """Linear models of p q r and of the flow's part in ay az, one for each of J delays."""

    def __init__(self, count: int) -> None:
        size = len(_PRECISION)
        self._moments: FloatArray = np.zeros((count, size, size + 3))
        self._forces: FloatArray = np.zeros((2, count, 3, 4))
        self._blocks = 0

    def score(
        self,
        signals: _Signals,
        u: FloatArray,  # (J, W, N + 2, 4) Inputs with each delay
    ) -> FloatArray | None:
        """Return squared prediction errors of p, q, r, (J, 3); None before the first updates."""
        if self._blocks < FEWEST_BLOCKS:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            error = self._predict(signals, u) - signals.x[:, 1:].swapaxes(0, 1)
            errors = (error**2).sum(axis=1)
        # A diverged prediction counts as a failed one.
        return np.asarray(np.fmin(errors, signals.worst).sum(axis=1))

    def learn(
        self,
        signals: _Signals,
        u: FloatArray,  # (M, 4) Inputs with the lag
        first: NDArray[np.intp],  # (J, W, samples) First step of each sample, with each delay
    ) -> None:
        """Add a block to the models' sums."""
        self._blocks += 1
        own, slopes = signals.means, signals.slopes
        means = sliding_window_view(u, SAMPLE, axis=0).mean(axis=-1)
        f = np.empty((*first.shape, len(_PRECISION)))
        f[..., :3], f[..., _INPUTS], f[..., _CONSTANT:] = own[..., :3], means[first], own[..., 3:]
        self._moments = _KEEP * self._moments + _products(f, slopes[..., :3])
        edges = 0.5 * (u[1:] + u[:-1])  # The step at an index, and the one after
        moved = (edges[first - 1 + SAMPLE] - edges[first - 1]) / (SAMPLE * STEP)
        f = np.ones((*first.shape, 3))
        for k, surface in enumerate(_SURFACES):
            f[..., 0], f[..., 1] = signals.turning[..., k], moved[..., surface]
            self._forces[k] = _KEEP * self._forces[k] + _products(f, slopes[..., 3 + k, None])

    def opposed(
        self,
        now: int,  # Index of the model without delay
    ) -> BoolArray:
        """Return flags, by each model, of rates p, q, r that the inputs oppose, (J, 3).

        An autopilot's inputs oppose the rates. Injected inputs make the rates of an aircraft that
        damps itself.
        """
        sums, rates = self._moments[now], slice(3)
        means = np.outer(sums[rates, _CONSTANT], sums[_CONSTANT, _INPUTS])
        together = sums[rates, _INPUTS] - means / max(float(sums[_CONSTANT, _CONSTANT]), STEP)
        effect = _solve(self._moments, _PRECISION)[:, _INPUTS]
        return np.asarray(np.einsum("kj,djk->dk", together, effect) < 0.0)

    def _predict(self, signals: _Signals, u: FloatArray) -> FloatArray:
        """Return the rates after each step of each window, (J, N, W, 3), from measured states."""
        v, count = signals.airspeed, len(u)
        a = _solve(self._moments, _PRECISION)  # (J, 10, 3)
        forces = _solve(self._forces, np.full(3, RIDGE))[..., 0]  # (2, J, 3)
        slopes = np.minimum(forces[..., 0], _LEAST_SLOPES[:, None])
        matrix, drive = np.zeros((count, 5, 5)), np.zeros((count, 4, 5))
        matrix[:, :3, :3], matrix[:, 3:, :3] = a[:, :3], a[:, _FORCES]
        matrix[:, 2, 3], matrix[:, 1, 4] = -slopes[0], slopes[1]
        drive[..., :3] = a[:, _INPUTS]
        start = np.empty((*u.shape[:2], 5))
        start[..., :3] = signals.x[:, 0]
        constant = np.empty((count, 5))
        constant[:, :3], constant[:, 3:] = a[:, _CONSTANT], forces[..., 2].T
        for k, surface in enumerate(_SURFACES):
            own = forces[k, :, 1]
            matrix[:, 3 + k, 3 + k] = slopes[k] / v
            drive[:, surface, :3] += own[:, None] * a[:, _FORCES.start + k]
            drive[:, surface, 3 + k] = own * slopes[k] / v
            moved = u[:, :, :2, surface].mean(axis=2)
            start[..., 3 + k] = signals.force[:, 0, k] - own[:, None] * moved
        # Step by step, the windows of each side by side: (J, N W, 5).
        flat = u[:, :, 1:-1].swapaxes(1, 2).reshape(count, -1, u.shape[-1])
        driven = flat @ drive + constant[:, None]
        down = 0.5 * (signals.down[:, 1:] + signals.down[:, :-1]) * GRAVITY / v
        driven[..., 3:] += slopes.T[:, None] * down.swapaxes(0, 1).reshape(-1, 2)
        # The trapezoidal rule is stable for every stable model.
        half = 0.5 * STEP * matrix
        after = np.linalg.inv(np.eye(5) - half)
        on, states = (np.eye(5) + half) @ after, STEP * driven @ after
        states[:, :WINDOWS] += start @ on
        reach = WINDOWS
        while reach < states.shape[1]:  # Sums of all before, by doubling
            states[:, reach:] += states[:, :-reach] @ on
            on, reach = on @ on, 2 * reach
        return states[..., :3].reshape(count, WINDOW, WINDOWS, 3)


def by_injection(
    found: Found,  # Delay and lag by the response to injected signals
    at_lag: Found,  # The same with the lag in use
    lag: float,  # Servo lag in use, s
) -> DelayEstimate:
    """Return the delay estimate from the response to injected signals."""
    total_sigma, sigma = (
        math.hypot(SYSTEMATIC_ERROR, math.sqrt(f.covariance[0, 0])) for f in (found, at_lag)
    )
    own, lag_sigma = found.lag
    return DelayEstimate(
        delay=at_lag.total - lag,
        sigma=sigma,
        total=max(found.total, 0.0),
        total_sigma=total_sigma,
        rise=min(found.rise, at_lag.rise),
        lag=own,
        lag_sigma=math.hypot(SYSTEMATIC_ERROR, lag_sigma),
        hidden=min(math.hypot(own - lag, lag_sigma), LAGS[-1]),
    )


def judge(
    errors: FloatArray,  # (B, L, J, 3) Squared errors of p, q, r in each block
    delays: FloatArray,  # (J,) The delays, s
    lag: float = 0.0,  # Servo lag in use, s; the bank's lags add to it
    opposed: BoolArray | bool = False,  # (J, 3) Whether the inputs oppose the rates
) -> DelayEstimate:
    """Return the delay of the best predictions, with its uncertainty.

    Each block has an unexplained motion of unknown variance. The likelihood of a delay therefore
    falls with the mean over blocks of the logarithm of their squared errors. A mean of the squared
    errors would depend on one block, a take-off or a gust.

    Sigma has three parts: the jackknife over blocks, half the difference of the flight's halves,
    and the lateness that an autopilot's answers can cause.
    """
    count = len(errors)
    logs = _logarithms(errors)
    mean = logs.mean(axis=0)
    halves = (logs[: count // 2].mean(axis=0), logs[count // 2 :].mean(axis=0))
    means = np.stack((mean, *halves, *(mean + (mean - logs) / (count - 1))))
    total, cost = np.exp(mean), means.mean(axis=3)
    _, least, inside = _vertices(cost, delays)
    # The squared error, not its logarithm, is a parabola.
    by_axis = np.exp(means - means.min(axis=2, keepdims=True))
    squares = by_axis.mean(axis=3)
    best, _, _ = _vertices(squares, delays)
    # A lag that is too long makes inputs act before they are given.
    early = np.minimum(best / SURE_SIGMA, 0.0)
    weight = np.where(inside, np.exp((least[:, :1] - least) / ALIKE - 0.5 * early**2), 0.0)
    weight[:, 0] = np.where(inside.any(axis=1), weight[:, 0], 1.0)
    weight /= weight.sum(axis=1, keepdims=True)
    sums = best + LAGS
    whole = (weight * sums).sum(axis=1)
    between = float((weight[0] * (sums[0] - whole[0]) ** 2).sum())
    found = np.stack((best[:, 0], whole), axis=1)
    # Variances of both, by the jackknife and by the halves.
    variance = (count - 1) * found[3:].var(axis=0) + 0.25 * (found[1] - found[2]) ** 2
    variance += _spread_of_axes(by_axis[0, 0], delays, float(best[0, 0])) ** 2
    middle = int(np.argmin(cost[0, 0]))
    answered = np.broadcast_to(opposed, total[0].shape)
    variance += SYSTEMATIC_ERROR**2 + _feedback_lateness(total[0], middle, answered[middle]) ** 2
    sides = np.clip([middle - APART, middle + APART], 0, len(delays) - 1)
    rises = cost[:, 0, sides] - cost[:, 0, [middle]]
    spread = np.sqrt((count - 1) * rises[3:].var(axis=0)) + np.finfo(float).tiny
    # An autopilot's answers follow the motion, like inputs that act before they are given.
    valid = inside[0, 0] and not (found[0, 0] < 0.0 and answered[np.abs(delays).argmin()].any())
    return DelayEstimate(
        delay=float(found[0, 0]),
        sigma=math.sqrt(variance[0]),
        total=max(float(whole[0]), 0.0) + lag,
        total_sigma=math.sqrt(variance[1] + between),
        rise=float((rises[0] / spread).min()) if valid else 0.0,
        hidden=math.sqrt(float(weight[0] @ np.square(LAGS))),
    )


def _logarithms(errors: FloatArray) -> FloatArray:
    """Return the logarithms of errors, finite for an error of zero."""
    return np.asarray(np.log(np.maximum(errors, np.finfo(float).tiny)))


def _spread_of_axes(
    squares: FloatArray,  # (J, 3) Squared errors of p, q, r, relative to the least of each
    delays: FloatArray,  # (J,) The delays, s
    best: float,  # Delay of the least sum, s
) -> float:
    """Return the standard deviation of `best` by the disagreement of the three rates, s.

    All inputs have one delay. Each rate pulls at the minimum of the sum by its own slope there
    (cluster-robust variance with three clusters; Liang and Zeger 1986).
    """
    middle = int(np.clip(squares.sum(axis=1).argmin(), 1, len(delays) - 2))
    low, here, high = squares[middle - 1 : middle + 2]
    curvature = low - 2.0 * here + high
    pull = 0.5 * (high - low) + curvature * (best - float(delays[middle])) / STEP
    count, whole = squares.shape[1], float(curvature.sum())
    if whole <= 0.0:
        return 0.0
    return STEP * math.sqrt(count / (count - 1) * float(pull @ pull)) / whole


def _feedback_lateness(
    errors: FloatArray,  # (J, 3) Squared errors of p, q, r
    middle: int,  # Index of the least errors
    opposed: BoolArray,  # (3,) Whether the inputs oppose p, q, r
) -> float:
    """Return the lateness of the inputs that feedback from unexplained motion can cause, s.

    Where an autopilot's answers outweigh the injected signals, unexplained motion makes the inputs
    look later, by the time of an answer times its share. With flow angles gusts are explained.
    """
    beside = errors[[max(middle - 1, 0), min(middle + 1, len(errors) - 1)]].sum(axis=0)
    weight = np.maximum(beside / errors[middle] - 2.0, 0.0)
    share = np.where(opposed, np.sqrt(errors[middle] / errors.max(axis=0)), 0.0)
    return float(ANSWER_TIMES[0]) * float((weight * share).sum() / max(float(weight.sum()), STEP))


def _vertices(
    cost: FloatArray,  # (..., J)
    delays: FloatArray,  # (J,) Its delays, s
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return a parabola's minimum: delay, cost, and whether it is inside the range, (...)."""
    least = cost.argmin(axis=-1)
    inside = (least > 0) & (least < len(delays) - 1)
    middle = np.clip(least, 1, len(delays) - 2)
    low, here, high = (
        np.take_along_axis(cost, middle[..., None] + k, axis=-1)[..., 0] for k in (-1, 0, 1)
    )
    curvature = low - 2.0 * here + high
    slope = 0.5 * (low - high)
    off = np.divide(slope, curvature, out=np.zeros_like(slope), where=inside & (curvature > 0.0))
    return delays[middle] + STEP * off, here - 0.5 * slope * off, inside


def _smoothed(values: FloatArray, h: float) -> FloatArray:
    """Return means over a step about each edge, or cell, of width `h`, s; less at the ends.

    All signals are averaged alike, so that the equations between them still hold. A vibration
    faster than the bank's steps would otherwise alias to a slow, unexplained motion.
    """
    reach = int(0.5 * STEP / h)
    if reach == 0:
        return values
    sums = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)))
    place = np.arange(len(values))
    around = np.minimum(reach, np.minimum(place, place[::-1]))  # Symmetric at the ends, too
    return np.asarray(
        (sums[place + around + 1] - sums[place - around]) / (2.0 * around + 1.0)[:, None]
    )


def _interpolate(grid: FloatArray, t: FloatArray, values: FloatArray) -> FloatArray:
    """Return columns of values at `t`, interpolated on a grid."""
    return np.stack([np.interp(grid, t, column) for column in values.T], axis=1)


def _integral(cells: FloatArray, t: FloatArray) -> FloatArray:
    """Return the integral from the first edge on of cell values, (M + 1, c)."""
    added = np.cumsum(cells * np.diff(t)[:, None], axis=0)
    return np.vstack((np.zeros(cells.shape[1]), added))


def _lagged(u: FloatArray, lag: float) -> FloatArray:
    """Return means over steps of lagged inputs, without the first `_LAG_STEPS` steps."""
    if lag == 0.0:
        return u[_LAG_STEPS:]
    keep = math.exp(-STEP / lag)
    mean = (1.0 - keep) * lag / STEP
    weights = [1.0 - mean, *((1.0 - keep) * mean * keep ** np.arange(_LAG_STEPS))]
    weights[-1] += 1.0 - sum(weights)
    return np.stack([np.convolve(column, weights, "valid") for column in u.T], axis=1)


def _means(edges: FloatArray) -> FloatArray:
    """Return means over the samples of values at the edges of steps, (W, N + 1, c)."""
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    shape = (len(edges), WINDOW // SAMPLE, SAMPLE, edges.shape[-1])
    return np.asarray(middle.reshape(shape).mean(axis=2))


def _slopes(edges: FloatArray) -> FloatArray:
    """Return rates of change over the samples of values at the edges of steps, (..., N + 1, c)."""
    return np.asarray(np.diff(edges[..., ::SAMPLE, :], axis=-2) / (SAMPLE * STEP))


def _products(f: FloatArray, y: FloatArray) -> FloatArray:
    """Return sums of f f^T and f y^T side by side, (J, k, k + m), times the samples' time."""
    left = f.reshape(len(f), -1, f.shape[-1])
    right = np.broadcast_to(y, (*f.shape[:-1], y.shape[-1])).reshape(*left.shape[:2], -1)
    both = np.concatenate((left, right), axis=2)
    return np.asarray(SAMPLE * STEP * left.transpose(0, 2, 1) @ both)


def _solve(sums: FloatArray, precision: FloatArray) -> FloatArray:
    """Solve the sums of `_products` by least squares, with a prior about zero, (..., k, m)."""
    k = len(precision)
    return np.linalg.solve(sums[..., :k] + np.diag(precision), sums[..., k:])
