# SPDX-License-Identifier: Apache-2.0
"""The score of record: how well the published coefficients predict the next seconds, freely.

A window starts at every tick t. The model is run from the measured state at t, with the
coefficients published by t and the measured inputs, for 1, 3 and 5 s, and is compared with every
gyro sample of the window. Nothing else that was measured after t enters: attitude is integrated,
forces follow from the model; a structure that has the forces as regressors holds them at their
value at t. The fit of an axis over a set of windows is

    fit = 100 (1 - |predicted - measured| / |measured - mean|),

norms and mean over all compared samples (the normalised fit of Ljung, System Identification,
1999). Nothing is filtered. Beside it stand the fit of holding the initial rate, and that of the
model with the specific forces as measured inside the window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.frames import centripetal, lever_arm_matrix
from uav_ident_ros.identification.model import (
    DRIVE_COLUMNS,
    Step,
    bounded,
    flight_derivative,
    integrate,
    off_centre,
    rates_derivative,
    with_measured_force,
)
from uav_ident_ros.identification.samples import NS, TimeArray
from uav_ident_ros.identification.structure import (
    EXOGENOUS_COLUMNS,
    LAST_COLUMNS,
    BoolArray,
    FloatArray,
    Structure,
)

HORIZONS = (1.0, 3.0, 5.0)
"""How far the model predicts, s: a controller plans over the first, a pilot over the last."""

LARGEST_STEP_NS = 10_000_000
"""Integration step, ns: at 10 ms the Runge-Kutta error of a 20 rad/s mode is below 1e-5."""

MAX_GAP = 0.2
"""A gap in the rates longer than this, s, leaves nothing to compare with: no window spans it."""

INPUT_TIMEOUT = 0.5
"""An input older than this, s, is unknown: no window needs one."""

SETTLED_NS = 30_000_000_000
"""Windows that start this long after the first rates count as settled, ns."""

LAST_PART = 0.4
"""Share of the flight at its end that the first figure is over."""

BLOCK = 4096
"""Windows integrated at a time: their arrays then stay in the processor's cache."""


@dataclass(frozen=True)
class InputSignal:
    """The inputs as a function of time: sampled, delayed and lagged.

    Parameters
    ----------
    t_ns : (M,) int array
        Stamps, ns, strictly rising.
    u : (M, 4) array
        de, dr, da, dth, deviations from trim.
    delay : float
        Transport delay, s.
    time_constant : float
        First-order lag, s; it starts in equilibrium.
    interpolation : str
        ``linear`` between the samples (the score of record) or ``hold``.
    """

    t_ns: TimeArray
    u: FloatArray
    delay: float = 0.0
    time_constant: float = 0.0
    interpolation: str = "linear"

    @property
    def delay_ns(self) -> int:
        """Transport delay, ns."""
        return round(self.delay * 1e9)

    def at(self, t_ns: TimeArray, *, left: bool = False) -> FloatArray:
        """Evaluate the inputs at the times `t_ns`, shape (len(t_ns), 4).

        Parameters
        ----------
        t_ns : (k,) int array
            Times, ns. Before the first sample the first is taken, after the last the last.
        left : bool
            At a jump take the value before it, not the one after.
        """
        acting_ns = t_ns - self.delay_ns
        last = np.searchsorted(self.t_ns, acting_ns, side="left" if left else "right") - 1
        last = np.maximum(last, 0)
        since = np.maximum(acting_ns - self.t_ns[last], 0)[:, None] * NS
        slope = self._slopes()
        value = self.u[last] + slope[last] * since
        if self.time_constant == 0.0:
            return np.asarray(value)
        # Exact solution of T y' = v - y for a straight line v(t): y = v - slope T + decay.
        ahead = slope[last] * self.time_constant
        start = self._lagged(slope)[last] - self.u[last] + ahead
        return np.asarray(value - ahead + start * np.exp(-since / self.time_constant))

    def _slopes(self) -> FloatArray:
        slope = np.zeros_like(self.u)
        if self.interpolation == "linear" and len(self.t_ns) > 1:
            slope[:-1] = np.diff(self.u, axis=0) / (np.diff(self.t_ns) * NS)[:, None]
        return slope

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
class FlowStates:
    """What the state of a structure with flow angles has beside the rates, at each of K ticks.

    Parameters
    ----------
    angles : (K, 2) array
        Sideslip and angle of attack, rad.
    down : (K, 3) array
        Unit vector that points down, body axes FRD.
    airspeed : (K,) array
        True airspeed, m/s.
    """

    angles: FloatArray
    down: FloatArray
    airspeed: FloatArray

    def chosen(self, which: BoolArray) -> FlowStates:
        """Return those of the chosen ticks, shape (K,)."""
        return FlowStates(self.angles[which], self.down[which], self.airspeed[which])


def flow_states(estimates: Sequence[Estimate]) -> FlowStates | None:
    """Return the flow states of estimates; None if their structure has none."""
    flows = [estimate.flow for estimate in estimates if estimate.flow is not None]
    if not flows:
        return None
    angles, attitude = (
        np.array([[getattr(flow, name) for name in names] for flow in flows])
        for names in (("beta", "alpha"), ("roll", "pitch"))
    )
    roll, pitch = attitude.T
    down = np.stack(
        [-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], axis=1
    )
    return FlowStates(angles, down, np.array([flow.airspeed for flow in flows]))


@dataclass(frozen=True)
class WindowErrors:
    """Sums over the compared samples of each of W windows, up to each of H horizons.

    Parameters
    ----------
    t_ns : (W,) int array
        Start of each window, ns.
    count : (W, H) int array
        Compared samples; 0 where the flight does not cover the window.
    model : (W, H, 3) array
        Squared errors of the free prediction, summed.
    hold : (W, H, 3) array
        The same with the initial rate held.
    measured_force : (W, 3) array
        The same of the model with measured forces, over the first horizon; NaN where the
        structure has no use for them.
    measured, measured_square : (W, H, 3) array
        Measured rates, and their squares, summed.
    """

    t_ns: TimeArray
    count: TimeArray
    model: FloatArray
    hold: FloatArray
    measured_force: FloatArray
    measured: FloatArray
    measured_square: FloatArray

    @staticmethod
    def none() -> WindowErrors:
        """Return the sums of no window at all."""
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
    """Fit over a set of windows, percent; p, q, r.

    Parameters
    ----------
    free : (H, 3) array
        Of the free prediction over each of `HORIZONS`; NaN if there is no window.
    free_hold : (H, 3) array
        The same of holding the initial rate.
    measured_force : (3,) array
        Of the model with measured forces over the first horizon; NaN where the structure has no
        use for them.
    windows : int
        Number of windows.
    samples : int
        Number of compared samples, first horizon.
    """

    free: FloatArray
    free_hold: FloatArray
    measured_force: FloatArray
    windows: int
    samples: int

    @property
    def model(self) -> FloatArray:
        """The headline: the free prediction over 1 s, shape (3,)."""
        return np.asarray(self.free[0])

    @property
    def hold(self) -> FloatArray:
        """Holding the initial rate over 1 s, shape (3,)."""
        return np.asarray(self.free_hold[0])


Selection = Callable[[TimeArray, int, int], BoolArray]
"""Chooses windows: (starts, first stamp, last stamp of the flight, all ns) to flags."""

SELECTIONS: Mapping[str, Selection] = {
    "last_40_percent": lambda t, first, last: t >= last - round(LAST_PART * (last - first)),
    "after_30_s": lambda t, first, last: t >= first + SETTLED_NS,
}
"""The sets of windows of the score of record."""


@dataclass(frozen=True)
class Flown:
    """What was measured, on one time base.

    Parameters
    ----------
    t_ns : (N,) int array
        Stamps of the gyro samples, ns, strictly rising; they may be irregular.
    rates : (N, 3) array
        Measured p, q, r, rad/s, FRD, unfiltered.
    inputs : InputSignal
        Measured inputs.
    force : (N, 2) array or None
        Measured ay, az, m/s^2, FRD, at the gyro samples; None counts as zero.
    lever_arm : (3,) array or None
        Position of the accelerometer from the centre of gravity, m, FRD; None is zero.
    """

    t_ns: TimeArray
    rates: FloatArray
    inputs: InputSignal
    force: FloatArray | None = None
    lever_arm: FloatArray | None = None

    @property
    def arm(self) -> FloatArray:
        """Lever arm, m, shape (3,)."""
        return np.zeros(3) if self.lever_arm is None else np.asarray(self.lever_arm, np.float64)

    def steady_force(self) -> FloatArray:
        """Return ay, az less their centripetal part, m/s^2, shape (N, 2)."""
        force = np.zeros((len(self.rates), 2)) if self.force is None else self.force
        return force - centripetal(self.rates, self.arm) if self.arm.any() else force


@dataclass(frozen=True)
class Published:
    """What was published, tick by tick.

    Parameters
    ----------
    t_ns : (K,) int array
        Ticks, ns, strictly rising.
    coefficients : (K, R, n) array
        Coefficients published at each tick, SI, FRD. One that is not finite makes its window's
        prediction a divergent one.
    structure : Structure
        Their structure.
    flow : FlowStates or None
        Flow angles and attitude; for a structure that has them.
    """

    t_ns: TimeArray
    coefficients: FloatArray
    structure: Structure
    flow: FlowStates | None = None

    @classmethod
    def of(cls, estimates: Sequence[Estimate], structure: Structure) -> Published:
        """Return what estimates of a structure published."""
        return cls(
            np.array([estimate.t_ns for estimate in estimates], dtype=np.int64),
            np.array([estimate.coefficients for estimate in estimates]),
            structure,
            flow_states(estimates),
        )

    def chosen(self, which: BoolArray) -> Published:
        """Return what was published at the chosen ticks, shape (K,)."""
        flow = None if self.flow is None else self.flow.chosen(which)
        return Published(self.t_ns[which], self.coefficients[which], self.structure, flow)


def score(
    flown: Flown, published: Published, selections: Mapping[str, Selection] = SELECTIONS
) -> dict[str, PredictionFit]:
    """Score what was published on a flight: a `PredictionFit` for each selection of windows."""
    errors = window_errors(flown, published)
    return score_windows(errors, int(flown.t_ns[0]), int(flown.t_ns[-1]), selections)


def score_windows(
    errors: WindowErrors,
    first_ns: int,
    last_ns: int,
    selections: Mapping[str, Selection] = SELECTIONS,
) -> dict[str, PredictionFit]:
    """Score windows of a flight that lasts from `first_ns` to `last_ns`."""
    return {
        name: fit(errors, choose(errors.t_ns, first_ns, last_ns))
        for name, choose in selections.items()
    }


def fit(errors: WindowErrors, chosen: BoolArray) -> PredictionFit:
    """Fit over the `chosen` windows, shape (W,)."""
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

    Raises
    ------
    ValueError
        If stamps do not rise or shapes do not match.
    """
    _check(flown, published)
    covered = _covered(flown, published.t_ns, HORIZONS[0])
    if not covered.any():
        return WindowErrors.none()
    published = published.chosen(covered)
    ticks = published.t_ns
    grid = _Grid.build(flown, ticks)
    x0 = _interpolated(ticks, flown.t_ns, flown.rates)
    ends = [_window_end(flown, ticks, horizon) for horizon in HORIZONS]
    nodes = np.stack([np.searchsorted(grid.t_ns, end, side="right") - 1 for end in ends], axis=1)
    first = np.searchsorted(flown.t_ns, ticks, side="right")
    last = np.stack([np.searchsorted(flown.t_ns, end, side="right") for end in ends], axis=1)
    count = np.maximum(last - first[:, None], 0)
    total, square = (_sums(part, first, last) for part in (flown.rates, flown.rates**2))
    start = x0[:, None, :]
    measured_force = np.full((len(ticks), 3), np.nan)
    if published.structure.has_forces or published.structure.has_flow:
        forced = _squared_errors(published, flown, grid, x0, nodes[:, :1], free=False)
        measured_force = forced[:, 0]
    return WindowErrors(
        t_ns=ticks,
        count=count,
        model=_squared_errors(published, flown, grid, x0, nodes, free=True),
        hold=np.maximum(square - 2.0 * start * total + count[..., None] * start**2, 0.0),
        measured_force=measured_force,
        measured=total,
        measured_square=square,
    )


def predict_ahead(
    flown: Flown, published: Published, horizon: float = HORIZONS[0]
) -> tuple[TimeArray, FloatArray]:
    """Predict from every tick to one `horizon`, s, later, where the measurements cover that.

    Returns
    -------
    t_ns : (W,) int array
        Times that the predictions are for, ns: a tick plus the horizon.
    predicted : (W, 3) array
        Predicted p, q, r, rad/s, FRD: the rates at the end of the windows of `window_errors`.

    Raises
    ------
    ValueError
        If stamps do not rise or shapes do not match.
    """
    _check(flown, published)
    published = published.chosen(_covered(flown, published.t_ns, horizon))
    ticks = published.t_ns
    if not len(ticks):
        return ticks, np.empty((0, 3))
    ends = ticks + round(horizon * 1e9)
    grid = _Grid.build(flown, np.union1d(ticks, ends))
    x0 = _interpolated(ticks, flown.t_ns, flown.rates)
    last = np.searchsorted(grid.t_ns, ends)
    predicted = np.empty_like(x0)
    for block in _blocks(len(ticks)):
        run = _BlockRun(published.chosen(block), flown, grid, free=True)
        predicted[block] = run.last_rates(x0[block], last[block])
    return ends, predicted


def _check(flown: Flown, published: Published) -> None:
    stamped = (("rates", flown.t_ns), ("inputs", flown.inputs.t_ns), ("ticks", published.t_ns))
    for name, stamps in stamped:
        if (np.diff(stamps) <= 0).any():
            raise ValueError(f"the stamps of the {name} do not rise")
    if len(flown.t_ns) != len(flown.rates) or len(flown.inputs.t_ns) != len(flown.inputs.u):
        raise ValueError("stamps and samples differ in number")
    structure, shape = published.structure, published.coefficients.shape
    wanted = (len(published.t_ns), *structure.mask.shape)
    if shape != wanted:
        raise ValueError(
            f"coefficients have shape {shape}: {wanted} is needed for the ticks and structure "
            f"'{structure.name}'"
        )
    if structure.has_flow and published.flow is None:
        raise ValueError(f"structure '{structure.name}' needs the flow states of the ticks")


def _covered(flown: Flown, ticks_ns: TimeArray, horizon: float) -> BoolArray:
    """Flag the ticks whose whole window has rates and inputs."""
    t_ns, inputs = flown.t_ns, flown.inputs
    if not len(t_ns) or not len(inputs.t_ns):
        return np.zeros(len(ticks_ns), dtype=bool)
    end = ticks_ns + round(horizon * 1e9)
    acting = inputs.t_ns + inputs.delay_ns
    timeout_ns = round(INPUT_TIMEOUT * 1e9)
    inside = (ticks_ns >= t_ns[0]) & (end <= t_ns[-1])
    known = (ticks_ns >= acting[0]) & (end <= acting[-1] + timeout_ns)
    gap = _meets_gap(ticks_ns, end, t_ns, round(MAX_GAP * 1e9))
    input_gap = _meets_gap(ticks_ns, end, acting, timeout_ns)
    return np.asarray(inside & known & ~gap & ~input_gap)


def _window_end(flown: Flown, ticks: TimeArray, horizon: float) -> TimeArray:
    """End of each window, ns; before its start where the flight does not cover it."""
    covered = _covered(flown, ticks, horizon)
    return np.asarray(ticks + np.where(covered, round(horizon * 1e9), -1))


def _meets_gap(start: TimeArray, end: TimeArray, t_ns: TimeArray, longest_ns: int) -> BoolArray:
    """Whether [start, end] meets an interval between stamps longer than `longest_ns`."""
    gaps = np.flatnonzero(np.diff(t_ns) > longest_ns)
    begun = np.searchsorted(t_ns[gaps], end, side="left")
    over = np.searchsorted(t_ns[gaps + 1], start, side="right")
    return np.asarray(begun > over)


def _sums(values: FloatArray, first: TimeArray, last: TimeArray) -> FloatArray:
    """Sum the rows first (W,) to before last (W, H), shape (W, H, 3)."""
    running = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=running[1:])
    return np.asarray(running[np.maximum(last, first[:, None])] - running[first][:, None])


def _interpolated(at_ns: TimeArray, t_ns: TimeArray, values: FloatArray) -> FloatArray:
    """Straight lines through samples, shape (len(at_ns), width)."""
    at, t = (at_ns - t_ns[0]) * NS, (t_ns - t_ns[0]) * NS
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


@dataclass(frozen=True)
class _Grid:
    """Everything measured, on one time grid: gyro samples, ticks, corners of the inputs.

    Between two nodes all signals are smooth, so every step of the integration is too.
    """

    t_ns: TimeArray  # (G,) Nodes, ns
    compared: BoolArray  # (G,) Which of them are gyro samples
    rates: FloatArray  # (3, G) Measured rates
    # (7, G) Regressors de, dr, da, dth, 1, ay, az just after and just before the nodes
    after: FloatArray
    before: FloatArray
    middle: FloatArray  # (7, G) The same halfway to the next node

    @classmethod
    def build(cls, flown: Flown, ticks: TimeArray) -> _Grid:
        t_ns, inputs, force = flown.t_ns, flown.inputs, flown.steady_force()
        corners = inputs.t_ns + inputs.delay_ns
        corners = corners[(corners > t_ns[0]) & (corners < t_ns[-1])]
        nodes = np.unique(np.concatenate([t_ns, ticks, corners]))
        nodes = np.concatenate([nodes, _fillers(nodes)])
        nodes.sort()
        middle = np.concatenate([(nodes[:-1] + nodes[1:]) // 2, nodes[-1:]])

        def exogenous(t: TimeArray, *, left: bool = False) -> FloatArray:
            u = inputs.at(t, left=left)
            return np.vstack([u.T, np.ones(len(t)), _interpolated(t, t_ns, force).T])

        after = exogenous(nodes)
        jumps = inputs.interpolation == "hold" and inputs.time_constant == 0.0
        return cls(
            t_ns=nodes,
            compared=np.isin(nodes, t_ns, assume_unique=True),
            rates=np.ascontiguousarray(_interpolated(nodes, t_ns, flown.rates).T),
            after=after,
            before=exogenous(nodes, left=True) if jumps else after,
            middle=exogenous(middle),
        )


def _fillers(nodes: TimeArray) -> TimeArray:
    """Return times that cut every step longer than the largest into equal ones."""
    steps = np.diff(nodes)
    pieces = -(-steps // LARGEST_STEP_NS)
    long = np.flatnonzero(pieces > 1)
    cut = [nodes[i] + steps[i] * np.arange(1, pieces[i]) // pieces[i] for i in long]
    return np.concatenate(cut) if cut else np.empty(0, dtype=np.int64)


def _blocks(count: int) -> Iterator[BoolArray]:
    """Yield flags that choose `count` windows, a block of them at a time."""
    place = np.arange(count) // BLOCK
    for k in range(-(-count // BLOCK)):
        yield place == k


def _squared_errors(
    published: Published,
    flown: Flown,
    grid: _Grid,
    x0: FloatArray,
    ends: TimeArray,
    *,
    free: bool,
) -> FloatArray:
    """Sum the squared prediction errors of every window up to its ends (W, H), (W, H, 3)."""
    errors = np.zeros((*ends.shape, 3))
    for block in _blocks(len(ends)):
        run = _BlockRun(published.chosen(block), flown, grid, free=free)
        errors[block] = run.squared_errors(x0[block], ends[block])
    return errors


class _BlockRun:
    """The model in many windows side by side: the states are arrays of W values.

    Parameters
    ----------
    published : Published
        Coefficients of each window; its ticks are the starts.
    flown : Flown
        What was measured.
    grid : _Grid
        The same on the nodes.
    free : bool
        Whether the forces are the model's own, or held; as measured if not.
    """

    def __init__(self, published: Published, flown: Flown, grid: _Grid, *, free: bool) -> None:
        structure, a = published.structure, published.coefficients
        self._grid = grid
        self._start = np.searchsorted(grid.t_ns, published.t_ns)
        self._flow = published.flow if free else None
        self._holds_force = free and structure.has_forces
        if self._flow is None:
            a = with_measured_force(a, structure)
            if flown.arm.any() and (structure.has_forces or structure.has_flow):
                a = off_centre(a, lever_arm_matrix(flown.arm))
            self._columns = list(range(*EXOGENOUS_COLUMNS.indices(structure.size)))
        else:
            self._columns = DRIVE_COLUMNS
        self._a: FloatArray = np.ascontiguousarray(np.moveaxis(a, 0, 2))
        self._rows = 3 if self._flow is None else len(structure.rows)
        present = self._a[:, self._columns].any(axis=2)
        self._terms = [(int(i), int(j)) for i, j in np.argwhere(present[: self._rows])]

    def squared_errors(self, x: FloatArray, ends: TimeArray) -> FloatArray:
        """Sum the squared errors up to the nodes `ends` (W, H), from the rates x (W, 3)."""
        grid, furthest, before = self._grid, ends.max(axis=1), self._start
        running = np.zeros((3, len(x)))
        sums = np.zeros((ends.shape[1], 3, len(x)))
        for node, state in self._states(x, furthest):
            # at the last node of all a window waits for the others
            counts = grid.compared[node] & (node <= furthest) & (node > before)
            before = node
            running += np.where(counts, (np.array(state[:3]) - grid.rates[:, node]) ** 2, 0.0)
            for total, end in zip(sums, ends.T, strict=True):
                reached = node == end
                if reached.any():
                    total[:, reached] = running[:, reached]
        return np.asarray(sums.transpose(2, 0, 1))

    def last_rates(self, x: FloatArray, end: TimeArray) -> FloatArray:
        """Return the rates at the node `end` of each window, shape (W, 3), from x (W, 3)."""
        last = x.copy()
        for node, state in self._states(x, end):
            reached = node == end
            last[reached] = np.array(state[:3])[:, reached].T
        return last

    def _states(
        self, x: FloatArray, end: TimeArray
    ) -> Iterator[tuple[TimeArray, list[FloatArray]]]:
        """Yield node after node (W,) with the state there, until all are at their end."""
        state = list(x.T)
        if self._flow is None:
            derivative = rates_derivative(self._a)
        else:
            derivative = flight_derivative(self._a)
            state += [*self._flow.angles.T, *self._flow.down.T]
        node = self._start
        for _ in range(int((end - node).max(initial=0))):
            following = np.minimum(node + 1, len(self._grid.t_ns) - 1)
            with np.errstate(over="ignore", invalid="ignore"):
                (state,) = integrate(derivative, state, [self._step(node, following)])
            # what is held at the bound has diverged; clipping turns an overflow into a number
            state = [bounded(part) for part in state]
            yield following, state
            node = following

    def _step(self, node: TimeArray, following: TimeArray) -> Step:
        """Return what drives the models from `node` to `following`, and for how long."""
        grid = self._grid
        dt = (grid.t_ns[following] - grid.t_ns[node]) * NS
        drives = [
            self._drive(signals, at)
            for signals, at in ((grid.after, node), (grid.middle, node), (grid.before, following))
        ]
        return drives[0], drives[1], drives[2], dt

    def _drive(self, exogenous: FloatArray, node: TimeArray) -> list[FloatArray]:
        """Evaluate the part of the model that does not depend on the state."""
        drive: list[FloatArray] = list(np.zeros((self._rows, len(node))))
        for i, j in self._terms:
            column = self._columns[j]
            held = self._holds_force and column >= LAST_COLUMNS.start
            value = self._grid.after[j, self._start] if held else exogenous[j, node]
            drive[i] += self._a[i, column] * value
        if self._flow is not None:
            still = np.zeros(len(node))
            drive += [1.0 / self._flow.airspeed, still, still, still]
        return drive
