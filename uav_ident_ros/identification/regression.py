# SPDX-License-Identifier: Apache-2.0
"""The regression problem ``y = A f``, linear in the coefficients.

State-variable filter: with the same low-pass H(s) on every regressor and s H(s) on the rates,
``s H x = A H f(x, u)`` holds exactly for every plant of the structure, and nothing is
differentiated (Young 1981; Garnier and Wang 2008, ch. 1).

With sideslip and angle of attack the moment rows are regressed on ay and az, which stand for the
angles, ``beta = (ay - Y_p p - Y_r r - Y_dr dr) / Y_beta``. Each force row is regressed on the
kinematics of its angle::

    s H ay = Y_beta H[p alpha - r + (ay + g d_y) / V] + s H (Y_p p + Y_r r + Y_dr dr)
             + Y_beta (c H p + b)
    s H az = Z_alpha H[q - p beta + (az + g d_z) / V] + Z_de s H de + Z_alpha a
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.filters import BlockFilter, low_pass
from uav_ident_ros.identification.frames import lever_arm_matrix
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.scales import SAMPLE_TIME, TINY
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    INPUTS,
    LAST_COLUMNS,
    MAIN_COLUMNS,
    MAIN_PLACES,
    OWN_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)

NEGLIGIBLE = TINY**0.25
"""Magnitude below which a signal counts as zero: its fourth power must not underflow."""


_FLOW_STATE = np.r_[RATE_COLUMNS, LAST_COLUMNS]
"""Columns of p, q, r, sideslip and angle of attack."""

_TURNING = np.array([1.0, -1.0])
"""Signs of p times the other angle, less r or q, in the rate of sideslip and angle of attack."""


@dataclass(frozen=True)
class Layout:
    """Rows and columns of the regression problem of a structure.

    Without flow angles they are those of the structure. With flow angles ay and az take the columns
    of beta and alpha. More columns follow: the kinematics of both angles, and the derivatives of
    the rates and surfaces that add to the forces.
    """

    rows: int
    size: int  # Columns of f
    index: NDArray[np.intp]  # (rows, k) Regressor columns of each row
    place: NDArray[np.intp]  # (rows, k, 2) Estimated entry of the structure: row, column
    used: BoolArray  # (rows, k) Flags of the regressors; a row may have fewer than k

    @cached_property
    def width(self) -> int:
        """Largest number of regressors of a row, k."""
        return self.index.shape[1]

    @cached_property
    def driven_by(self) -> NDArray[np.intp]:
        """Input of each instrument, (rows, k): itself, or else the row's main input."""
        aileron, elevator, rudder = MAIN_PLACES  # The rudder makes side force, the elevator lift
        rows = np.array([aileron, elevator, rudder, rudder, elevator])[: self.rows]
        own = self.index - INPUT_COLUMNS.start
        return np.where((own >= 0) & (own < len(INPUTS)), own, rows[:, None])

    @cached_property
    def main(self) -> NDArray[np.intp]:
        """Entry of the main input in each moment row, (3,)."""
        return np.array([self.index[i].tolist().index(j) for i, j in enumerate(MAIN_COLUMNS)])

    @cached_property
    def rolling(self) -> list[int]:
        """Entry of p in the row of ay; none without that row."""
        places = self.place[len(ROWS) : len(ROWS) + 1]
        return [row[:, 1].tolist().index(RATE_COLUMNS.start) for row in places]

    @cached_property
    def surfaces(self) -> NDArray[np.intp]:
        """Row, entry, and moment row of each effect of the main inputs, (3, 3 ... 4).

        Moments come first. The side force of the rudder, in a row of its own, is part of the same
        effect: it is that of the fin. The elevator's lift is small beside that of the wing.
        """
        effects = [(i, entry, i) for i, entry in enumerate(self.main.tolist())]
        for row in range(len(ROWS), self.rows)[:1]:
            for entry in np.flatnonzero(self.used[row]).tolist():
                moment = np.flatnonzero(self.place[row, entry, 1] == MAIN_COLUMNS)
                effects += [(row, entry, i) for i in moment.tolist()]
        return np.array(effects, dtype=np.intp).T

    @cached_property
    def effects(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the structure that the effects of `surfaces` estimate."""
        row, entry, _ = self.surfaces
        return self.place[row, entry, 0], self.place[row, entry, 1]

    @cached_property
    def signals(self) -> tuple[NDArray[np.intp], FloatArray]:
        """Columns of `Regression.signals` in `RowSamples`, (rows, 2 + 2 k), and their factors.

        The first column is replaced by the residual. A factor, (rows, 1, 2 + 2 k), is 1, or 0 where
        a row has no regressor.
        """
        own = np.arange(self.rows)[:, None]
        regressors = self.rows + self.index
        picked = np.hstack((own, own, regressors, regressors + self.size))
        there = np.ones(picked.shape)
        there[:, 2:] = np.tile(self.used, 2)
        return picked, there[:, None]

    @cached_property
    def _places(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Places of the used entries, and of their columns."""
        used, rows = np.flatnonzero(self.used), np.arange(self.rows)[:, None]
        return used, (self.size * rows + self.index).ravel()[used]

    def matrix(self, linear: FloatArray) -> FloatArray:
        """Return coefficients (rows, k) at their columns, shape (rows, c)."""
        entries, columns = self._places
        matrix = np.zeros(self.rows * self.size)
        matrix[columns] = linear.ravel()[entries]
        return matrix.reshape(self.rows, self.size)


def differentiated_columns(structure: Structure) -> list[int]:
    """Return the columns of rates and inputs whose derivatives are regressors of the force rows."""
    return sorted({j for flow in structure.flow for j in flow.others})


@lru_cache(maxsize=16)
def layout(structure: Structure) -> Layout:
    """Return the layout of the regression problem of a structure."""
    # Of each entry: its column, and the row and column of the structure that it estimates
    rows = [[(j, i, j) for j in np.flatnonzero(row)] for i, row in enumerate(structure.mask[:3])]
    size = structure.size
    if structure.has_flow:
        differentiated = differentiated_columns(structure)
        for k, flow in enumerate(structure.flow):
            first = size + len(structure.flow)
            rows.append(
                [
                    (size + k, flow.force, flow.angle),
                    *((first + differentiated.index(j), flow.force, j) for j in flow.others),
                    *((j, flow.kinematics, j) for j in flow.missing),
                ]
            )
        size += len(structure.flow) + len(differentiated)
    width = max(len(row) for row in rows)
    entries = np.array([row + [(0, 0, 0)] * (width - len(row)) for row in rows], dtype=np.intp)
    used = np.arange(width) < np.array([[len(row)] for row in rows])
    return Layout(len(rows), size, entries[..., 0], entries[..., 1:], used)


@dataclass
class Regression:
    """Samples of the regression problem.

    Parameters
    ----------
    signals : (m, rows + 2 c) array
        y, f and z side by side.
    rows : int
        Columns of y.
    dt : float
        Time that each sample stands for, s.
    restarted : bool
        Whether the first sample does not continue those before.
    injected : bool
        Whether the instruments are the response to the injected signals only.

    Attributes
    ----------
    y : (m, rows) array
        Angular accelerations, filtered, rad/s^2; with flow angles also aydot, azdot, m/s^3.
    f : (m, c) array
        Regressors, filtered.
    z : (m, c) array
        Instruments: the regressors of the model's own state, filtered.
    time : float
        Time that all samples together stand for, s.
    """

    signals: FloatArray
    rows: int
    dt: float
    restarted: bool = False
    injected: bool = False

    def __post_init__(self) -> None:
        m, columns = self.signals.shape
        instruments = (columns + self.rows) // 2
        self.y = self.signals[:, : self.rows]
        self.f = self.signals[:, self.rows : instruments]
        self.z = self.signals[:, instruments:]
        self.time = self.dt * m

    @classmethod
    def of(cls, y: FloatArray, f: FloatArray, z: FloatArray, dt: float, **flags: bool) -> Self:
        """Return the samples of y, f and z."""
        return cls(np.concatenate((y, f, z), axis=1), y.shape[1], dt, **flags)

    @classmethod
    def join(cls, parts: Sequence[Regression]) -> Regression:
        """Join consecutive samples."""
        return replace(parts[0], signals=np.concatenate([part.signals for part in parts]))

    def continued_by(self, more: Regression) -> bool:
        """Return whether more samples continue these, so that both can be joined."""
        return not more.restarted and (more.dt, more.injected) == (self.dt, self.injected)

    def means(self) -> Regression:
        """Return means over about `SAMPLE_TIME`."""
        m = len(self.signals)
        count = min(m, max(1, round(self.time / SAMPLE_TIME)))
        begin, width = _parts(m, count)
        means = np.add.reduceat(self.signals, begin) / width
        return Regression(means, self.rows, self.time / count, self.restarted, self.injected)

    def residual(self, coefficients: FloatArray) -> FloatArray:
        """Return ``e = y - A f`` of coefficients of shape (rows, c); shape (m, rows)."""
        return np.asarray(self.y - self.f @ coefficients.T)


class RowSamples:
    """Samples of the regression problem, row by row.

    Parameters
    ----------
    signals : (..., rows, m, 2 + 2 k) array
        Residual, y, the k regressors and the k instruments of each row; 0 where unused.
    dt : float
        Time that each sample stands for, s.

    Attributes
    ----------
    residual, y : (..., rows, m) array
        Residual of the coefficients before the update, and y.
    f, z : (..., rows, m, k) array
        Regressors and instruments.
    width, count : int
        Numbers k and m.
    time : float
        Time that all samples together stand for, s.
    """

    def __init__(self, signals: FloatArray, dt: float) -> None:
        self.signals, self.dt = signals, dt
        self.count, self.width = signals.shape[-2], signals.shape[-1] // 2 - 1
        self.time = dt * self.count
        self.residual, self.y = signals[..., 0], signals[..., 1]
        self.f, self.z = signals[..., 2 : 2 + self.width], signals[..., 2 + self.width :]

    @classmethod
    def of(cls, samples: Regression, residual: FloatArray, layout: Layout) -> Self:
        """Return samples with residuals (m, rows), in rows by a layout."""
        picked, there = layout.signals
        rows = cls(samples.signals.take(picked, axis=1).swapaxes(0, 1) * there, samples.dt)
        rows.residual[:] = residual.T
        return rows

    @classmethod
    def join(cls, parts: Sequence[RowSamples]) -> Self:
        """Join consecutive samples."""
        return cls(np.concatenate([part.signals for part in parts], axis=-2), parts[-1].dt)

    def times(self, share: float) -> RowSamples:
        """Return the samples with their instruments times `share`."""
        rows = RowSamples(self.signals.copy(), self.dt)
        rows.z[:] *= share
        return rows

    def by_regressors(self) -> RowSamples:
        """Return the samples with the regressors as instruments, as for least squares."""
        rows = RowSamples(self.signals.copy(), self.dt)
        rows.z[:] = rows.f
        return rows


@lru_cache(maxsize=64)
def _parts(m: int, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where `count` parts of m samples begin, and their sizes, (count, 1)."""
    begin = np.arange(count) * m // count
    return begin, np.diff(begin, append=m)[:, None]


class StateVariableFilter:
    """Filter from blocks of signals to regressors, instruments and accelerations.

    At a restart the filters of differentiated signals start in equilibrium and all others at zero.
    The equation then holds from the first sample on, without a transient.
    """

    def __init__(
        self,
        structure: Structure,
        cutoff: float,  # Of the low-pass, rad/s
        h: float,  # Width of the cells, s
        lever_arm: FloatArray,  # (3,) Of the accelerometer from the centre of gravity, m, FRD
    ) -> None:
        self._structure = structure
        self._lever = lever_arm_matrix(lever_arm)
        columns, flows = differentiated_columns(structure), len(structure.flow)
        self._rates = [j for j in columns if j < INPUT_COLUMNS.start]
        surfaces = columns[len(self._rates) :]
        self._surfaces = [j - INPUT_COLUMNS.start for j in surfaces]
        self._rows, self._size = len(ROWS) + flows, structure.size + flows
        # Columns in which z differs from f: rates, inputs, the flow angles and their turning, and
        # the author's regressors
        every = range(self._size)
        angles = [*every[LAST_COLUMNS], *every[structure.size :]] if flows else []
        more = every[OWN_COLUMNS.start : structure.size]
        self._own = np.array([*every[: INPUT_COLUMNS.stop], *angles, *more])
        # Channels: the differentiated signals (rates, with flow angles also ay, az and their
        # surfaces), then f, and these columns of z.
        self._first = self._rows + len(surfaces)
        channels = self._first + self._size + len(self._own)
        self._filter = BlockFilter(*low_pass(cutoff), h, channels)
        # Of y, f and z side by side: indices of the channels, and then of their derivatives.
        low, slope = np.arange(2 * channels).reshape(2, -1)
        f, of_model = np.split(low[self._first :], [self._size])
        z, moved = f.copy(), slope[-len(self._own) :]
        z[self._own] = of_model
        turned = slope[[j - RATE_COLUMNS.start for j in self._rates]]
        deflected = slope[self._rows : self._first]
        known = [*slope[: self._rows], *f, *turned, *deflected, *z, *moved[self._rates]]
        # The injected signals are in z alone.
        self._picked = [np.array([*known, *part]) for part in (deflected, moved[surfaces])]

    def apply(
        self,
        block: Block,  # Signals over m cells
        # (n,) Factor of each of the structure's regressors in the moment rows at the airspeed flown
        scale: FloatArray | None = None,
        # (R, n) Coefficients of the model; its forces follow from them
        coefficients: FloatArray | None = None,
    ) -> Regression:
        """Filter one block."""
        lines, held = self._channels(block, coefficients)
        if scale is not None:
            factor = self._factor(scale)
            lines *= factor
            held *= factor
        if block.restarted:
            self._filter.state = np.zeros_like(self._filter.state)
            known = slice(0, self._first)
            self._filter.state[0, known] = lines[0, known] + held[0, known]
        low, slope = self._filter.apply(lines, held)
        signals = np.concatenate((low, slope), axis=1).take(self._picked[block.injected], axis=1)
        signals = without_negligible(signals)
        found = Regression(signals, self._rows, block.h, block.restarted, block.injected)
        if scale is not None and self._rates:
            found.f[:, self._size : self._size + len(self._rates)] *= scale[self._rates]
        return found

    def _channels(
        self, block: Block, coefficients: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the channels over the cells: straight lines between edges, and held values."""
        n, m, v = self._structure.size, len(block.u), block.airspeed
        driven_by = block.excitation if block.injected else block.u
        assert driven_by is not None
        # As measured, for f, and of the model, for z
        states = np.array((block.state, block.model_state))
        inputs = np.array((block.u, driven_by))
        # The differentiated signals, then f and z
        line, lines = np.zeros((m + 1, self._first)), np.zeros((2, m + 1, self._size))
        hold, held = np.zeros((m, self._first)), np.zeros((2, m, self._size))
        line[:, :3] = block.x
        lines[..., :n] = self._structure.regressor(states[..., :3], np.zeros(len(INPUTS)))
        held[..., INPUT_COLUMNS] = inputs
        if n > CONSTANT_COLUMN:
            lines[..., LAST_COLUMNS] = block.force
        beside = np.zeros((m, 2)) if block.by_turning is None else block.by_turning
        if v is not None:
            assert coefficients is not None
            made = coefficients[3:5]
            lines[1, :, LAST_COLUMNS] = block.model_state[:, :5] @ made.take(_FLOW_STATE, 1).T
            turning = (lines[..., LAST_COLUMNS] + GRAVITY * states[..., 6:]) / v
            turning += (states[..., :1] * states[..., 4:2:-1] - states[..., 2:0:-1]) * _TURNING
            lines[..., n:] = turning
            by_inputs = driven_by @ made[:, INPUT_COLUMNS].T
            held[1, :, LAST_COLUMNS], held[1, :, n:] = by_inputs, by_inputs / v
            line[:, 3:5], hold[:, 5:] = block.force, block.u[:, self._surfaces]
            if block.early is not None:
                # A surface acts on the accelerometer at once, also by the lever arm.
                at_once = made + self._lever @ coefficients[: len(ROWS)]
                beside = beside + block.early @ at_once[:, INPUT_COLUMNS].T
            hold[:, 3:5] -= beside
            held[0, :, n:] -= beside / v
        if n > CONSTANT_COLUMN:
            held[0, :, LAST_COLUMNS] -= beside
        if self._structure.own:
            lines[..., OWN_COLUMNS.start : n] = 0.0
            middle = 0.5 * (states[:, 1:, :3] + states[:, :-1, :3])
            held[..., OWN_COLUMNS.start : n] = self._structure.own_values(middle, inputs)
        return self._joined(line, lines), self._joined(hold, held)

    def _joined(self, known: FloatArray, both: FloatArray) -> FloatArray:
        """Return the channels of the differentiated signals, and of f and z, (2, ..., size)."""
        return np.concatenate((known, both[0], both[1].take(self._own, axis=-1)), axis=-1)

    def _factor(self, scale: FloatArray) -> FloatArray:
        """Return the channels' factors to the reference airspeed; forces stand for angles."""
        n, known, both = len(scale), np.ones(self._first), np.ones((2, self._size))
        both[:, :n] = scale
        if self._structure.has_flow:
            both[:, LAST_COLUMNS] = 1.0
            both[:, n:] = scale[LAST_COLUMNS][0]
            known[5:] = scale[INPUT_COLUMNS][self._surfaces]
        return self._joined(known, both)


def diagonal(matrices: FloatArray) -> FloatArray:
    """Return writable diagonals of contiguous square matrices (..., k, k), shape (..., k)."""
    *stack, k, _ = matrices.shape
    return matrices.reshape(*stack, k * k)[..., :: k + 1]


def without_negligible(signals: FloatArray) -> FloatArray:
    """Return signals with negligible values set to zero."""
    return np.where(np.abs(signals) < NEGLIGIBLE, 0.0, signals)


# --- the derivative as in the paper ---------------------------------------------------------------


class BackwardDifference:
    """Regression problem of one sample a tick: ``xdot = (x_k - x_(k-1)) / dt``.

    Kept to reproduce the paper exactly; at 20 Hz it ruins the estimate even without noise.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self._before: tuple[int, FloatArray] | None = None

    def step(
        self,
        t_ns: int,  # Of the tick
        x: FloatArray,  # (3,) Rates at the tick, rad/s, FRD
        u: FloatArray,  # (4,) Inputs at the tick
        force: FloatArray,  # (2,) Specific forces ay, az at the tick, m/s^2
        dt: float,  # Between ticks, s
    ) -> Regression | None:
        """Return the sample of this tick, None at the first one."""
        before, self._before = self._before, (t_ns, x)
        if before is None or (t_ns - before[0]) * NS > 1.5 * dt:
            return None
        f = without_negligible(self._structure.regressor(x, u, force))[None]
        y = without_negligible((x - before[1]) / dt)[None]
        return Regression.of(y, f, f, dt)
