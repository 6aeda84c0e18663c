# SPDX-License-Identifier: Apache-2.0
"""The score of record: how well the published coefficients predict the next second.

A window starts at every tick t. The model ``xdot = A f(x, u)`` is run from the measured rates
at t, with the coefficients published by t and the measured inputs, for one second, and is
compared with every gyro sample of the window. The fit of an axis over a set of windows is

    fit = 100 (1 - |predicted - measured| / |measured - mean|),

norms and mean over all compared samples (the normalised fit of Ljung, System Identification,
1999). Nothing is filtered. Beside it stand two baselines: holding the initial rate, and, where
ay and az are regressors, running the model with both held at their value at t.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from uav_ident_ros.identification.frames import centripetal, lever_arm_matrix
from uav_ident_ros.identification.model import LARGEST_RATE
from uav_ident_ros.identification.samples import NS, TimeArray
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    SPECIFIC_FORCES,
    BoolArray,
    FloatArray,
    Structure,
)

WINDOW_NS = 1_000_000_000
"""Length of a window, ns: one second, over which a controller plans."""

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

_STATE_COLUMNS = 8
_CONSTANT_COLUMN = 12
_PRODUCTS = ((0, 1), (1, 2), (0, 2), (0, 0), (2, 2))
"""Which rates the first five regressors are products of."""


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
        asked = t_ns - self.delay_ns
        last = np.searchsorted(self.t_ns, asked, side="left" if left else "right") - 1
        last = np.maximum(last, 0)
        since = np.maximum(asked - self.t_ns[last], 0)[:, None] * NS
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
class WindowErrors:
    """Sums over the compared samples of each of W windows.

    Parameters
    ----------
    t_ns : (W,) int array
        Start of each window, ns.
    count : (W,) int array
        Compared samples.
    model : (W, 3) array
        Squared prediction errors of the model, summed.
    hold : (W, 3) array
        The same with the initial rate held.
    held_force : (W, 3) array
        The same of the model with ay and az held at their value at the start; NaN where the
        structure has none.
    measured : (W, 3) array
        Measured rates, summed.
    measured_square : (W, 3) array
        Their squares, summed.
    """

    t_ns: TimeArray
    count: TimeArray
    model: FloatArray
    hold: FloatArray
    held_force: FloatArray
    measured: FloatArray
    measured_square: FloatArray

    @staticmethod
    def none() -> WindowErrors:
        """Return the sums of no window at all."""
        no_time, nothing = np.empty(0, dtype=np.int64), np.empty((0, 3))
        return WindowErrors(no_time, no_time, nothing, nothing, nothing, nothing, nothing)

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
    model : (3,) array
        The 1-second prediction fit; NaN if there is no window.
    hold : (3,) array
        The same of holding the initial rate.
    held_force : (3,) array
        The same of the model with ay and az held; NaN where the structure has none.
    windows : int
        Number of windows.
    samples : int
        Number of compared samples.
    """

    model: FloatArray
    hold: FloatArray
    held_force: FloatArray
    windows: int
    samples: int


Selection = Callable[[TimeArray, int, int], BoolArray]
"""Chooses windows: (starts, first stamp, last stamp of the flight, all ns) to flags."""

SELECTIONS: Mapping[str, Selection] = {
    "last_40_percent": lambda t, first, last: t >= last - round(LAST_PART * (last - first)),
    "after_30_s": lambda t, first, last: t >= first + SETTLED_NS,
}
"""The sets of windows of the score of record."""


def score(
    t_ns: TimeArray,
    rates: FloatArray,
    inputs: InputSignal,
    force: FloatArray | None,
    ticks_ns: TimeArray,
    coefficients: FloatArray,
    structure: Structure,
    *,
    lever_arm: FloatArray | None = None,
    selections: Mapping[str, Selection] = SELECTIONS,
) -> dict[str, PredictionFit]:
    """Score the coefficients of a flight; parameters as in `window_errors`.

    Parameters
    ----------
    selections : mapping
        The sets of windows to score, by name.

    Returns
    -------
    dict
        A `PredictionFit` for each selection.
    """
    errors = window_errors(
        t_ns, rates, inputs, force, ticks_ns, coefficients, structure, lever_arm=lever_arm
    )
    return score_windows(errors, int(t_ns[0]), int(t_ns[-1]), selections)


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
    samples = int(errors.count[chosen].sum())
    if samples:
        mean = errors.measured[chosen].sum(axis=0) / samples
        spread = errors.measured_square[chosen].sum(axis=0) - samples * mean**2
    else:
        spread = np.full(3, np.nan)
    spread = np.where(spread > 0.0, spread, np.nan)

    def percent(squares: FloatArray) -> FloatArray:
        return np.asarray(100.0 * (1.0 - np.sqrt(squares[chosen].sum(axis=0) / spread)))

    return PredictionFit(
        percent(errors.model),
        percent(errors.hold),
        percent(errors.held_force),
        int(np.count_nonzero(chosen)),
        samples,
    )


def window_errors(
    t_ns: TimeArray,
    rates: FloatArray,
    inputs: InputSignal,
    force: FloatArray | None,
    ticks_ns: TimeArray,
    coefficients: FloatArray,
    structure: Structure,
    *,
    lever_arm: FloatArray | None = None,
) -> WindowErrors:
    """Run the model through the window of every tick that the measurements cover.

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
    ticks_ns : (K,) int array
        Ticks, ns, strictly rising.
    coefficients : (K, 3, n) array
        Coefficients published at each tick, SI, FRD. One that is not finite makes its window's
        prediction a divergent one.
    structure : Structure
        Their structure.
    lever_arm : (3,) array, optional
        Position of the accelerometer from the centre of gravity, m, FRD.

    Raises
    ------
    ValueError
        If stamps do not rise or shapes do not match.
    """
    _check(t_ns, rates, inputs, ticks_ns, coefficients, structure)
    arm, force = _arm_and_force(rates, force, lever_arm)
    usable = _covered(ticks_ns, t_ns, inputs)
    if not usable.any():
        return WindowErrors.none()
    ticks = ticks_ns[usable]
    grid = _Grid.build(t_ns, rates, inputs, force, ticks)
    model = _effective(coefficients[usable], structure, arm)
    first = np.searchsorted(t_ns, ticks, side="right")
    end = np.searchsorted(t_ns, ticks + WINDOW_NS, side="right")
    count = end - first
    total, square = _sums(rates, first, end), _sums(rates**2, first, end)
    x0 = grid.interpolated(ticks, t_ns, rates)
    held_force = np.full((len(ticks), 3), np.nan)
    if structure.size > INPUT_COLUMNS.stop:
        held_force = _squared_errors(model, x0, grid, ticks, hold_force=True)
    return WindowErrors(
        t_ns=ticks,
        count=count,
        model=_squared_errors(model, x0, grid, ticks, hold_force=False),
        hold=np.maximum(square - 2.0 * x0 * total + count[:, None] * x0**2, 0.0),
        held_force=held_force,
        measured=total,
        measured_square=square,
    )


def _arm_and_force(
    rates: FloatArray, force: FloatArray | None, lever_arm: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return the lever arm, and the forces less their centripetal part; zero where not given."""
    arm = np.zeros(3) if lever_arm is None else np.asarray(lever_arm, dtype=np.float64)
    force = np.zeros((len(rates), 2)) if force is None else force
    return arm, force - centripetal(rates, arm) if arm.any() else force


def predict_ahead(
    t_ns: TimeArray,
    rates: FloatArray,
    inputs: InputSignal,
    force: FloatArray | None,
    ticks_ns: TimeArray,
    coefficients: FloatArray,
    structure: Structure,
    *,
    horizon_ns: int = WINDOW_NS,
    lever_arm: FloatArray | None = None,
) -> tuple[TimeArray, FloatArray]:
    """Predict from every tick to one `horizon_ns` later, where the measurements cover that.

    The other parameters are those of `window_errors`, and so are the predictions: these are
    the rates at the end of its windows.

    Returns
    -------
    t_ns : (W,) int array
        Times that the predictions are for, ns: a tick plus the horizon.
    predicted : (W, 3) array
        Predicted p, q, r, rad/s, FRD.

    Raises
    ------
    ValueError
        If stamps do not rise or shapes do not match.
    """
    _check(t_ns, rates, inputs, ticks_ns, coefficients, structure)
    arm, force = _arm_and_force(rates, force, lever_arm)
    usable = _covered(ticks_ns, t_ns, inputs, horizon_ns)
    ticks = ticks_ns[usable]
    if not len(ticks):
        return ticks, np.empty((0, 3))
    grid = _Grid.build(t_ns, rates, inputs, force, np.union1d(ticks, ticks + horizon_ns))
    model = _effective(coefficients[usable], structure, arm)
    x0 = grid.interpolated(ticks, t_ns, rates)
    start = np.searchsorted(grid.t_ns, ticks)
    end = np.searchsorted(grid.t_ns, ticks + horizon_ns)
    predicted = np.empty_like(x0)
    for k in range(0, len(ticks), BLOCK):
        block = slice(k, k + BLOCK)
        run = _BlockRun(model[block], grid, start[block], hold_force=False)
        predicted[block] = run.last_state(x0[block], end[block]).T
    return ticks + horizon_ns, predicted


def _check(
    t_ns: TimeArray,
    rates: FloatArray,
    inputs: InputSignal,
    ticks_ns: TimeArray,
    coefficients: FloatArray,
    structure: Structure,
) -> None:
    for name, stamps in (("rates", t_ns), ("inputs", inputs.t_ns), ("ticks", ticks_ns)):
        if (np.diff(stamps) <= 0).any():
            raise ValueError(f"the stamps of the {name} do not rise")
    if len(t_ns) != len(rates) or len(inputs.t_ns) != len(inputs.u):
        raise ValueError("stamps and samples differ in number")
    if coefficients.shape != (len(ticks_ns), 3, structure.size):
        raise ValueError(
            f"coefficients have shape {coefficients.shape}: ({len(ticks_ns)}, 3, "
            f"{structure.size}) is needed for the ticks and structure '{structure.name}'"
        )


def _covered(
    ticks_ns: TimeArray, t_ns: TimeArray, inputs: InputSignal, window_ns: int = WINDOW_NS
) -> BoolArray:
    """Flag the ticks whose whole window has rates and inputs."""
    if not len(t_ns) or not len(inputs.t_ns):
        return np.zeros(len(ticks_ns), dtype=bool)
    end = ticks_ns + window_ns
    acting = inputs.t_ns + inputs.delay_ns
    timeout_ns = round(INPUT_TIMEOUT * 1e9)
    inside = (ticks_ns >= t_ns[0]) & (end <= t_ns[-1])
    known = (ticks_ns >= acting[0]) & (end <= acting[-1] + timeout_ns)
    gap = _meets_gap(ticks_ns, end, t_ns, round(MAX_GAP * 1e9))
    input_gap = _meets_gap(ticks_ns, end, acting, timeout_ns)
    return np.asarray(inside & known & ~gap & ~input_gap)


def _meets_gap(start: TimeArray, end: TimeArray, t_ns: TimeArray, longest_ns: int) -> BoolArray:
    """Whether [start, end] meets an interval between stamps longer than `longest_ns`."""
    gaps = np.flatnonzero(np.diff(t_ns) > longest_ns)
    begun = np.searchsorted(t_ns[gaps], end, side="left")
    over = np.searchsorted(t_ns[gaps + 1], start, side="right")
    return np.asarray(begun > over)


def _effective(coefficients: FloatArray, structure: Structure, arm: FloatArray) -> FloatArray:
    """Coefficients for forces measured off the centre of gravity: (I + A_f L)^-1 A."""
    if not arm.any() or structure.size == INPUT_COLUMNS.stop:
        return coefficients
    forces = coefficients[:, :, -len(SPECIFIC_FORCES) :]
    return np.linalg.solve(np.eye(3) + forces @ lever_arm_matrix(arm), coefficients)


def _sums(values: FloatArray, first: TimeArray, end: TimeArray) -> FloatArray:
    """Sum the rows first..end-1, shape (len(first), 3)."""
    running = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=running[1:])
    return np.asarray(running[end] - running[first])


@dataclass(frozen=True)
class _Grid:
    """Everything measured, on one time grid: gyro samples, ticks, corners of the inputs.

    Between two nodes all signals are smooth, so every step of the integration is too.

    Parameters
    ----------
    t_ns : (G,) int array
        Nodes, ns.
    compared : (G,) bool array
        Which of them are gyro samples.
    rates : (3, G) array
        Measured rates.
    after, before : (7, G) array
        Exogenous regressors de, dr, da, dth, 1, ay, az just after and just before the nodes.
    middle : (7, G) array
        The same halfway to the next node.
    jumps : bool
        Whether `after` and `before` differ.
    """

    t_ns: TimeArray
    compared: BoolArray
    rates: FloatArray
    after: FloatArray
    before: FloatArray
    middle: FloatArray
    jumps: bool

    @classmethod
    def build(
        cls,
        t_ns: TimeArray,
        rates: FloatArray,
        inputs: InputSignal,
        force: FloatArray,
        ticks: TimeArray,
    ) -> _Grid:
        corners = inputs.t_ns + inputs.delay_ns
        corners = corners[(corners > t_ns[0]) & (corners < t_ns[-1])]
        nodes = np.unique(np.concatenate([t_ns, ticks, corners]))
        nodes = np.concatenate([nodes, _fillers(nodes)])
        nodes.sort()
        middle = np.concatenate([(nodes[:-1] + nodes[1:]) // 2, nodes[-1:]])

        def exogenous(t: TimeArray, *, left: bool = False) -> FloatArray:
            u = inputs.at(t, left=left)
            return np.vstack([u.T, np.ones(len(t)), cls.interpolated(t, t_ns, force).T])

        after = exogenous(nodes)
        jumps = inputs.interpolation == "hold" and inputs.time_constant == 0.0
        return cls(
            t_ns=nodes,
            compared=np.isin(nodes, t_ns, assume_unique=True),
            rates=np.ascontiguousarray(cls.interpolated(nodes, t_ns, rates).T),
            after=after,
            before=exogenous(nodes, left=True) if jumps else after,
            middle=exogenous(middle),
            jumps=jumps,
        )

    @staticmethod
    def interpolated(at_ns: TimeArray, t_ns: TimeArray, values: FloatArray) -> FloatArray:
        """Straight lines through samples, shape (len(at_ns), width)."""
        at, t = (at_ns - t_ns[0]) * NS, (t_ns - t_ns[0]) * NS
        return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def _fillers(nodes: TimeArray) -> TimeArray:
    """Return times that cut every step longer than the largest into equal ones."""
    steps = np.diff(nodes)
    pieces = -(-steps // LARGEST_STEP_NS)
    long = np.flatnonzero(pieces > 1)
    cut = [nodes[i] + steps[i] * np.arange(1, pieces[i]) // pieces[i] for i in long]
    return np.concatenate(cut) if cut else np.empty(0, dtype=np.int64)


def _squared_errors(
    model: FloatArray, x0: FloatArray, grid: _Grid, ticks: TimeArray, *, hold_force: bool
) -> FloatArray:
    """Sum the squared prediction errors of every window, shape (W, 3)."""
    start = np.searchsorted(grid.t_ns, ticks)
    end = np.searchsorted(grid.t_ns, ticks + WINDOW_NS, side="right") - 1
    errors = np.zeros((len(ticks), 3))
    for k in range(0, len(ticks), BLOCK):
        block = slice(k, k + BLOCK)
        run = _BlockRun(model[block], grid, start[block], hold_force)
        errors[block] = run.squared_errors(x0[block], end[block]).T
    return errors


class _BlockRun:
    """The model in many windows side by side: arrays are (3, W) or (W,)."""

    def __init__(self, model: FloatArray, grid: _Grid, start: TimeArray, hold_force: bool) -> None:
        self._a: FloatArray = np.ascontiguousarray(np.moveaxis(model, 0, 2))
        present = [(int(i), int(j)) for i, j in np.argwhere(self._a.any(axis=2))]
        self._state_terms = [(i, j) for i, j in present if j < _STATE_COLUMNS]
        self._drive_terms = [(i, j) for i, j in present if j >= _STATE_COLUMNS]
        self._grid = grid
        self._start = start
        self._hold_force = hold_force
        self._product: FloatArray = np.empty(len(start))

    def squared_errors(self, x: FloatArray, end: TimeArray) -> FloatArray:
        """Sum the squared errors, shape (3, W), from the initial rates (W, 3)."""
        sums = np.zeros((3, len(x)))
        for node, state in self._states(x, end):
            counts = self._grid.compared[node] & (node <= end)
            sums += np.where(counts, (state - self._grid.rates[:, node]) ** 2, 0.0)
        return sums

    def last_state(self, x: FloatArray, end: TimeArray) -> FloatArray:
        """Return the state at the node `end` of each window, shape (3, W); from (W, 3)."""
        last = np.ascontiguousarray(x.T)
        for node, state in self._states(x, end):
            last = np.where(node <= end, state, last)
        return last

    def _states(self, x: FloatArray, end: TimeArray) -> Iterator[tuple[TimeArray, FloatArray]]:
        """Yield node after node (W,) with the state there (3, W), until all are at their end."""
        grid = self._grid
        x = np.ascontiguousarray(x.T)
        node = self._start
        last = len(grid.t_ns) - 1
        drive = self._drive(grid.after, node)
        for _ in range(int((end - node).max(initial=0))):
            following = np.minimum(node + 1, last)
            h = (grid.t_ns[following] - grid.t_ns[node]) * NS
            middle = self._drive(grid.middle, node)
            drive_end = self._drive(grid.before, following)
            x = self._step(x, h, drive, middle, drive_end)
            # fmax and fmin also turn the NaN of an overflow into a number
            x = np.fmin(np.fmax(x, -LARGEST_RATE), LARGEST_RATE)
            yield following, x
            node = following
            drive = self._drive(grid.after, node) if grid.jumps else drive_end

    def _step(
        self, x: FloatArray, h: FloatArray, first: FloatArray, middle: FloatArray, last: FloatArray
    ) -> FloatArray:
        """Classical Runge-Kutta step of order 4."""
        half = 0.5 * h
        with np.errstate(over="ignore", invalid="ignore"):
            k1 = self._derivative(x, first)
            k2 = self._derivative(x + half * k1, middle)
            k3 = self._derivative(x + half * k2, middle)
            k4 = self._derivative(x + h * k3, last)
            return np.asarray(x + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4))

    def _derivative(self, x: FloatArray, drive: FloatArray) -> FloatArray:
        f = [x[i] * x[j] for i, j in _PRODUCTS]
        f += [x[0], x[1], x[2]]
        xdot = drive.copy()
        for i, j in self._state_terms:
            np.multiply(self._a[i, j], f[j], out=self._product)
            xdot[i] += self._product
        return xdot

    def _drive(self, exogenous: FloatArray, node: TimeArray) -> FloatArray:
        """Evaluate the part of A f that does not depend on the state, shape (3, W)."""
        drive = np.zeros((3, len(node)))
        values: dict[int, FloatArray] = {}
        for i, j in self._drive_terms:
            if j == _CONSTANT_COLUMN:
                drive[i] += self._a[i, j]
                continue
            if j not in values:
                held = self._hold_force and j > _CONSTANT_COLUMN
                row = self._grid.after if held else exogenous
                values[j] = row[j - _STATE_COLUMNS][self._start if held else node]
            np.multiply(self._a[i, j], values[j], out=self._product)
            drive[i] += self._product
        return drive
