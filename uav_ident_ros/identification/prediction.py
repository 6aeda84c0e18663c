# SPDX-License-Identifier: Apache-2.0
"""The score of record: free prediction of the next seconds by the published coefficients.

A window starts at every tick t. The model runs for 1, 3 and 5 s from the measured state at t, with
the coefficients published by t and the measured inputs, and is compared with every gyro sample of
the window. No other measurement after t enters: attitude is integrated, and forces follow from the
model. A structure with measured forces as regressors holds them at their value at t. The fit of an
axis over a set of windows is

    fit = 100 (1 - |predicted - measured| / |measured - mean|),

norms and mean over all compared samples (the normalised fit of Ljung, System Identification, 1999).
Nothing is filtered. Two other fits stand beside it: of holding the initial rate, and of the model
with the specific forces measured inside the window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.frames import centripetal, lever_arm_matrix
from uav_ident_ros.identification.model import (
    bounded,
    flight_derivative,
    integrate,
    off_centre,
    rates_derivative,
    with_measured_force,
    with_own,
)
from uav_ident_ros.identification.samples import NS, NS_PER_S, TimeArray
from uav_ident_ros.identification.structure import (
    EXOGENOUS_COLUMNS,
    INPUTS,
    LAST_COLUMNS,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)

HORIZONS = (1.0, 3.0, 5.0)
"""Horizons of the prediction, s: a controller plans over the first, a pilot over the last."""

LARGEST_STEP_NS = 10_000_000
"""Integration step, ns: at 10 ms the Runge-Kutta error of a 20 rad/s mode is below 1e-5."""

MAX_GAP = 0.2
"""Longest gap in the rates, s: no window spans a longer one."""

INPUT_TIMEOUT = 0.5
"""Largest age of an input, s: a window with an older input is left out."""

SETTLED_NS = 30_000_000_000
"""Windows that start this long after the first rates count as settled, ns."""

LAST_PART = 0.4
"""Share of the flight, at its end, of the first set of windows."""

_AY_ROW = LAST_COLUMNS.start - EXOGENOUS_COLUMNS.start
"""Row of ay among de, dr, da, dth, 1, ay, az."""


@dataclass(frozen=True)
class InputSignal:
    """The inputs as a function of time: straight lines between samples, delayed and lagged."""

    t_ns: TimeArray  # (M,) Stamps, ns, strictly rising
    u: FloatArray  # (M, 4) de, dr, da, dth, deviations from trim
    delay: float = 0.0  # Transport delay, s
    time_constant: float = 0.0  # First-order lag, s; it starts in equilibrium

    @property
    def delay_ns(self) -> int:
        """Transport delay, ns."""
        return round(self.delay * NS_PER_S)

    def at(self, t_ns: TimeArray) -> FloatArray:
        """Evaluate the inputs at the times `t_ns`, ns, shape (len(t_ns), 4).

        The first sample holds before it, the last after it.
        """
        acting_ns = t_ns - self.delay_ns
        last = np.maximum(np.searchsorted(self.t_ns, acting_ns, side="right") - 1, 0)
        since = np.maximum(acting_ns - self.t_ns[last], 0)[:, None] * NS
        slope = np.zeros_like(self.u)
        slope[:-1] = np.diff(self.u, axis=0) / (np.diff(self.t_ns) * NS)[:, None]
        value = self.u[last] + slope[last] * since
        if self.time_constant == 0.0:
            return np.asarray(value)
        # Exact solution of T y' = v - y for a straight line v(t): y = v - slope T + decay.
        ahead = slope[last] * self.time_constant
        start = self._lagged(slope)[last] - self.u[last] + ahead
        return np.asarray(value - ahead + start * np.exp(-since / self.time_constant))

    def _lagged(self, slope: FloatArray) -> FloatArray:
        """Lagged input at the samples, shape (M, 4)."""
        width = np.diff(self.t_ns)[:, None] * NS
        decay = np.exp(-width / self.time_constant)
        ahead = slope[:-1] * self.time_constant
        forced = self.u[:-1] + slope[:-1] * width - ahead - (self.u[:-1] - ahead) * decay
        lagged = [self.u[0].tolist()]
        for d, b in zip(decay[:, 0].tolist(), forced.tolist(), strict=True):
            lagged.append([d * y + v for y, v in zip(lagged[-1], b, strict=True)])
        return np.array(lagged)


@dataclass(frozen=True)
class WindowErrors:
    """Sums over the compared samples of each of W windows, up to each of H horizons."""

    t_ns: TimeArray  # (W,) Start of each window, ns
    count: TimeArray  # (W, H) Compared samples; 0 where the flight does not cover the window
    model: FloatArray  # (W, H, 3) Squared errors of the free prediction
    hold: FloatArray  # (W, H, 3) The same with the initial rate held
    # (W, 3) The same of the model with measured forces, over the first horizon; NaN where the
    # structure does not use them
    measured_force: FloatArray
    measured: FloatArray  # (W, H, 3) Measured rates
    measured_square: FloatArray  # (W, H, 3) Their squares

    @staticmethod
    def none() -> WindowErrors:
        """Return the sums of no window."""
        no_time = np.empty(0, dtype=np.int64)
        sums = np.empty((0, len(HORIZONS), 3))
        count = np.empty((0, len(HORIZONS)), dtype=np.int64)
        return WindowErrors(no_time, count, sums, sums, np.empty((0, 3)), sums, sums)

    @staticmethod
    def join(parts: Sequence[WindowErrors]) -> WindowErrors:
        """Join the windows of several stretches of a flight."""
        columns = {f.name: [getattr(part, f.name) for part in parts] for f in fields(WindowErrors)}
        return WindowErrors(**{name: np.concatenate(c) for name, c in columns.items()})


@dataclass(frozen=True)
class PredictionFit:
    """Fit over a set of windows, percent; p, q, r."""

    free: FloatArray  # (H, 3) Of the free prediction over `HORIZONS`; NaN if there is no window
    free_hold: FloatArray  # (H, 3) The same of holding the initial rate
    # (3,) Of the model with measured forces over the first horizon; NaN where the structure does
    # not use them
    measured_force: FloatArray
    windows: int
    samples: int  # Compared over the first horizon

    @property
    def model(self) -> FloatArray:
        """Fit of the free prediction over 1 s, the headline, shape (3,)."""
        return np.asarray(self.free[0])

    @property
    def hold(self) -> FloatArray:
        """Fit of holding the initial rate over 1 s, shape (3,)."""
        return np.asarray(self.free_hold[0])


SELECTIONS: Mapping[str, Callable[[TimeArray, int, int], BoolArray]] = {
    "last_40_percent": lambda t, first, last: t >= last - round(LAST_PART * (last - first)),
    "after_30_s": lambda t, first, last: t >= first + SETTLED_NS,
}
"""The sets of windows of the score of record: (starts, first stamp, last stamp of the flight, all
ns) to flags."""


@dataclass(frozen=True)
class Flown:
    """Measurements of a flight, on one time base."""

    t_ns: TimeArray  # (N,) Stamps of the gyro samples, ns, strictly rising, maybe irregular
    rates: FloatArray  # (N, 3) p, q, r, rad/s, FRD, unfiltered
    inputs: InputSignal
    force: FloatArray  # (N, 2) ay, az, m/s^2, FRD, at the gyro samples
    lever_arm: FloatArray  # (3,) Of the accelerometer from the centre of gravity, m, FRD


@dataclass(frozen=True)
class Published:
    """Published coefficients and flow angles, tick by tick."""

    t_ns: TimeArray  # (K,) Ticks, ns, strictly rising
    coefficients: FloatArray  # (K, R, n) SI, FRD; a prediction with a non-finite one has diverged
    structure: Structure
    # (K, 6) Flow angles, rad; the unit vector that points down, body axes FRD; the true airspeed,
    # m/s. None without flow angles
    flow: FloatArray | None = None

    @classmethod
    def of(cls, estimates: Sequence[Estimate], structure: Structure) -> Published:
        """Return the published values of estimates of a structure."""
        flows = [estimate.flow for estimate in estimates if estimate.flow is not None]
        return cls(
            np.array([estimate.t_ns for estimate in estimates], dtype=np.int64),
            np.array([estimate.coefficients for estimate in estimates]),
            structure,
            np.array([(f.beta, f.alpha, *f.down, f.airspeed) for f in flows]) if flows else None,
        )

    def chosen(self, which: BoolArray) -> Published:
        """Return the published values at the chosen ticks, flags of shape (K,)."""
        flow = None if self.flow is None else self.flow[which]
        return Published(self.t_ns[which], self.coefficients[which], self.structure, flow)


def score_windows(errors: WindowErrors, first_ns: int, last_ns: int) -> dict[str, PredictionFit]:
    """Score the windows of a flight that lasts from `first_ns` to `last_ns`, by `SELECTIONS`."""
    return {
        name: fit(errors, choose(errors.t_ns, first_ns, last_ns))
        for name, choose in SELECTIONS.items()
    }


def fit(errors: WindowErrors, chosen: BoolArray) -> PredictionFit:
    """Return the fit over the `chosen` windows, flags of shape (W,)."""
    count = errors.count[chosen].sum(axis=0)
    total, square = (sums[chosen].sum(axis=0) for sums in (errors.measured, errors.measured_square))
    spread = square - total**2 / np.maximum(count, 1)[:, None]
    spread = np.where(spread > 0.0, spread, np.nan)

    def percent(squares: FloatArray, spread: FloatArray) -> FloatArray:
        return np.asarray(100.0 * (1.0 - np.sqrt(squares[chosen].sum(axis=0) / spread)))

    return PredictionFit(
        percent(errors.model, spread),
        percent(errors.hold, spread),
        percent(errors.measured_force, spread[0]),
        int(np.count_nonzero(chosen)),
        int(count[0]),
    )


def window_errors(flown: Flown, published: Published) -> WindowErrors:
    """Run the model through the window of every tick that the measurements cover.

    Parameters
    ----------
    flown : Flown
        Measurements of the flight.
    published : Published
        Coefficients and flow angles of every tick.

    Returns
    -------
    WindowErrors
        Sums of squared errors, for `score_windows` and `fit`.

    See Also
    --------
    score_windows : The fits by the sets of windows of the score of record.
    predict_ahead : The predicted rates themselves.

    References
    ----------
    L. Ljung, System Identification, 1999, ch. 16: the normalised fit.

    Examples
    --------
    Pitch with a damping of -2 1/s and an elevator of -20 1/s^2 per rad, all known:

    >>> from uav_ident_ros.identification.structure import STRUCTURES
    >>> structure = STRUCTURES["baseline"]
    >>> t_ns = 10_000_000 * np.arange(1000)  # 10 s at 100 Hz
    >>> u, rates = np.zeros((1000, 4)), np.zeros((1000, 3))
    >>> u[:, 0] = 0.05 * np.sin(3e-9 * t_ns)
    >>> for k in range(999):
    ...     elevator = 0.5 * (u[k, 0] + u[k + 1, 0])
    ...     rates[k + 1, 1] = rates[k, 1] * np.exp(-0.02) - 10.0 * (1.0 - np.exp(-0.02)) * elevator
    >>> flown = Flown(t_ns, rates, InputSignal(t_ns, u), np.zeros((1000, 2)), np.zeros(3))
    >>> known = np.zeros((1, *structure.mask.shape))
    >>> known[:, *structure.index("qdot/q")] = -2.0
    >>> known[:, *structure.index("qdot/de")] = -20.0
    >>> ticks = 50_000_000 * np.arange(1, 200)
    >>> errors = window_errors(flown, Published(ticks, np.repeat(known, 199, axis=0), structure))
    >>> score = score_windows(errors, t_ns[0], t_ns[-1])["last_40_percent"]
    >>> bool(score.model[1] > 99.9)  # percent; p and r have not moved
    True
    """
    covered = _covered(flown, published.t_ns, HORIZONS[0])
    if not covered.any():
        return WindowErrors.none()
    published = published.chosen(covered)
    ticks, structure = published.t_ns, published.structure
    # Before its start where the flight does not cover the window
    lengths = [
        np.where(_covered(flown, ticks, ahead), round(ahead * NS_PER_S), -1) for ahead in HORIZONS
    ]
    ends = ticks[:, None] + np.stack(lengths, axis=1)
    first = np.searchsorted(flown.t_ns, ticks, side="right")
    last = np.searchsorted(flown.t_ns, ends, side="right")
    count = np.maximum(last - first[:, None], 0)
    total, square = (_sums(part, first, last) for part in (flown.rates, flown.rates**2))
    grid = _Grid.build(flown, ticks)
    start = _interpolated(ticks, flown.t_ns, flown.rates)[:, None]
    measured_force = np.full((len(ticks), 3), np.nan)
    if structure.has_forces or structure.has_flow:
        measured_force = _squared_errors(flown, grid, published, ends[:, :1], free=False)[:, 0]
    return WindowErrors(
        t_ns=ticks,
        count=count,
        model=_squared_errors(flown, grid, published, ends, free=True),
        hold=np.maximum(square - 2.0 * start * total + count[..., None] * start**2, 0.0),
        measured_force=measured_force,
        measured=total,
        measured_square=square,
    )


def predict_ahead(
    flown: Flown, published: Published, horizon: float = HORIZONS[0]
) -> tuple[TimeArray, FloatArray]:
    """Predict from every tick to one `horizon`, s, later, where the measurements cover that.

    Returned are the times that the predictions are for, ns, (W,), and the rates at the end of the
    windows of `window_errors`, (W, 3).
    """
    published = published.chosen(_covered(flown, published.t_ns, horizon))
    ticks = published.t_ns
    if not len(ticks):
        return ticks, np.empty((0, 3))
    ends = ticks + round(horizon * NS_PER_S)
    grid = _Grid.build(flown, np.union1d(ticks, ends))
    last, predicted = np.searchsorted(grid.t_ns, ends), np.empty((len(ticks), 3))
    for node, rates in _predictions(flown, grid, published, last, free=True):
        reached = node == last
        predicted[reached] = rates[:, reached].T
    return ends, predicted


def _covered(flown: Flown, ticks_ns: TimeArray, horizon: float) -> BoolArray:
    """Flag the ticks whose whole window has rates and inputs."""
    t_ns, inputs = flown.t_ns, flown.inputs
    if not len(t_ns) or not len(inputs.t_ns):
        return np.zeros(len(ticks_ns), dtype=bool)
    end = ticks_ns + round(horizon * NS_PER_S)
    acting = inputs.t_ns + inputs.delay_ns
    timeout_ns = round(INPUT_TIMEOUT * NS_PER_S)
    inside = (ticks_ns >= t_ns[0]) & (end <= t_ns[-1])
    known = (ticks_ns >= acting[0]) & (end <= acting[-1] + timeout_ns)
    gap = _meets_gap(ticks_ns, end, t_ns, round(MAX_GAP * NS_PER_S))
    input_gap = _meets_gap(ticks_ns, end, acting, timeout_ns)
    return np.asarray(inside & known & ~gap & ~input_gap)


def _meets_gap(start: TimeArray, end: TimeArray, t_ns: TimeArray, longest_ns: int) -> BoolArray:
    """Return whether [start, end] meets an interval between stamps longer than `longest_ns`."""
    gaps = np.flatnonzero(np.diff(t_ns) > longest_ns)
    begun = np.searchsorted(t_ns[gaps], end, side="left")
    over = np.searchsorted(t_ns[gaps + 1], start, side="right")
    return np.asarray(begun > over)


def _sums(values: FloatArray, first: TimeArray, last: TimeArray) -> FloatArray:
    """Return sums of the rows first (W,) to before last (W, H), shape (W, H, 3)."""
    running = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=running[1:])
    return np.asarray(running[np.maximum(last, first[:, None])] - running[first][:, None])


def _interpolated(at_ns: TimeArray, t_ns: TimeArray, values: FloatArray) -> FloatArray:
    """Return samples interpolated by straight lines, shape (len(at_ns), width)."""
    at, t = (at_ns - t_ns[0]) * NS, (t_ns - t_ns[0]) * NS
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


@dataclass(frozen=True)
class _Grid:
    """All measurements on one time grid: gyro samples, ticks, corners of the inputs.

    Between two nodes all signals are smooth, and so is every step of the integration.
    """

    t_ns: TimeArray  # (G,) Nodes, ns
    compared: BoolArray  # (G,) Which of them are gyro samples
    rates: FloatArray  # (3, G) Measured rates
    signals: FloatArray  # (7, G) Regressors de, dr, da, dth, 1, ay, az
    middle: FloatArray  # (7, G) The same halfway to the next node

    @classmethod
    def build(cls, flown: Flown, ticks: TimeArray) -> _Grid:
        t_ns, inputs = flown.t_ns, flown.inputs
        force = flown.force - centripetal(flown.rates, flown.lever_arm)
        corners = inputs.t_ns + inputs.delay_ns
        corners = corners[(corners > t_ns[0]) & (corners < t_ns[-1])]
        nodes = np.unique(np.concatenate([t_ns, ticks, corners]))
        nodes = np.concatenate([nodes, _fillers(nodes)])
        nodes.sort()
        middle = np.concatenate([(nodes[:-1] + nodes[1:]) // 2, nodes[-1:]])
        signals, halfway = (
            np.vstack([inputs.at(t).T, np.ones(len(t)), _interpolated(t, t_ns, force).T])
            for t in (nodes, middle)
        )
        return cls(
            t_ns=nodes,
            compared=np.isin(nodes, t_ns, assume_unique=True),
            rates=np.ascontiguousarray(_interpolated(nodes, t_ns, flown.rates).T),
            signals=signals,
            middle=halfway,
        )


def _fillers(nodes: TimeArray) -> TimeArray:
    """Return times that cut every step longer than the largest into equal ones."""
    steps = np.diff(nodes)
    pieces = -(-steps // LARGEST_STEP_NS)
    long = np.flatnonzero(pieces > 1)
    cut = [nodes[i] + steps[i] * np.arange(1, pieces[i]) // pieces[i] for i in long]
    return np.concatenate(cut) if cut else np.empty(0, dtype=np.int64)


def _squared_errors(
    flown: Flown, grid: _Grid, published: Published, ends_ns: TimeArray, *, free: bool
) -> FloatArray:
    """Sum the squared prediction errors of every window up to its ends (W, H), ns, (W, H, 3)."""
    ends = np.searchsorted(grid.t_ns, ends_ns, side="right") - 1
    furthest, before = ends.max(axis=1), np.searchsorted(grid.t_ns, published.t_ns)
    running, sums = np.zeros((3, len(ends))), np.zeros((*ends.shape, 3))
    for node, rates in _predictions(flown, grid, published, furthest, free=free):
        # A shorter window waits at its last node for the others
        counts = grid.compared[node] & (node <= furthest) & (node > before)
        before = node
        running += np.where(counts, (rates - grid.rates[:, node]) ** 2, 0.0)
        window, horizon = np.nonzero(node[:, None] == ends)
        sums[window, horizon] = running[:, window].T
    return sums


def _predictions(
    flown: Flown,
    grid: _Grid,
    published: Published,
    last: TimeArray,  # (W,) The node at which each window ends
    *,
    free: bool,  # Whether the forces are the model's own, or held; else as measured
) -> Iterator[tuple[TimeArray, FloatArray]]:
    """Run the model in W windows side by side; yield the node of each, and its rates, (3, W)."""
    structure, a = published.structure, published.coefficients
    node = start = np.searchsorted(grid.t_ns, published.t_ns)
    state = list(_interpolated(published.t_ns, flown.t_ns, flown.rates).T)
    flow = published.flow.T if free and published.flow is not None else None
    if flow is None:
        a = with_measured_force(a, structure)
        if flown.lever_arm.any() and (structure.has_forces or structure.has_flow):
            a = off_centre(a, lever_arm_matrix(flown.lever_arm))
    a = np.ascontiguousarray(np.moveaxis(a, 0, 2))
    known = a[:, EXOGENOUS_COLUMNS]
    if flow is None:
        rows, derivative, more = len(ROWS), rates_derivative(a), []
    else:
        rows, derivative, still = len(a), flight_derivative(a), np.zeros(len(node))
        known, more = known[:, :_AY_ROW], [1.0 / flow[5], still, still, still]
        state += list(flow[:5])
    derivative = with_own(derivative, a, structure)
    terms = np.argwhere(known[:rows].any(axis=2)).tolist()
    held = free and structure.has_forces

    def drive(signals: FloatArray, node: TimeArray) -> list[FloatArray]:
        """Evaluate the part of the model that does not depend on the state."""
        parts = list(np.zeros((rows, len(node))))
        for i, j in terms:
            value = grid.signals[j, start] if held and j >= _AY_ROW else signals[j, node]
            parts[i] += known[i, j] * value
        inputs = list(signals[: len(INPUTS), node]) if structure.own else []
        return parts + more + inputs

    driven = drive(grid.signals, node)
    for _ in range(int((last - node).max(initial=0))):
        following = np.minimum(node + 1, len(grid.t_ns) - 1)
        before, driven = driven, drive(grid.signals, following)
        dt = (grid.t_ns[following] - grid.t_ns[node]) * NS
        with np.errstate(over="ignore", invalid="ignore"):
            steps = [(before, drive(grid.middle, node), driven, dt)]
            (state,) = integrate(derivative, state, steps)
        # A state at the bound has diverged; clipping turns an overflow into a number
        state = [bounded(part) for part in state]
        node = following
        yield node, np.array(state[:3])
