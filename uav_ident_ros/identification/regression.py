# SPDX-License-Identifier: Apache-2.0
"""The regression problem of a tick: ``y = A f``, linear in what is estimated.

State-variable filter: with the same low-pass H(s) on every regressor and s H(s) on the rates,
``s H x = A H f(x, u)`` holds exactly for every plant of the structure, and nothing is ever
differentiated (Young 1981; Garnier and Wang 2008, ch. 1).

With sideslip and angle of attack the moment rows are regressed on ay and az, which stand for them,
``beta = (ay - Y_p p - Y_r r - Y_dr dr) / Y_beta``, and each force row on the kinematics of its
angle::

    s H ay = Y_beta H[-r + (ay + g d_y) / V] + s H (Y_p p + Y_r r + Y_dr dr) + Y_beta (c H p + b)
    s H az = Z_alpha H[q + (az + g d_z) / V] + Z_de s H de + Z_alpha a
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.filters import BlockFilter, low_pass
from uav_ident_ros.identification.frames import lever_arm_matrix
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    INPUTS,
    LAST_COLUMNS,
    MAIN_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    STATE_COLUMNS,
    BoolArray,
    FloatArray,
    Structure,
)

SAMPLE_TIME = 0.05
"""Time over which the filtered signals are averaged, s: the filter leaves nothing quicker."""

NEGLIGIBLE = 1e-30
"""Magnitude below which a signal counts as zero, SI: no sensor resolves it, and the square of
its square must be a number still."""


_MOMENTS, _MAIN_INPUTS = np.arange(len(ROWS)), MAIN_COLUMNS - INPUT_COLUMNS.start


@dataclass(frozen=True)
class Layout:
    """Rows and columns of the regression problem of a structure.

    Without flow angles they are those of the structure. With them ay, az stand where the
    structure has beta, alpha, and more columns follow: the kinematics of both angles, and the
    derivatives of the rates and the surfaces that add to their forces.

    Parameters
    ----------
    rows, size : int
        Rows, and columns of f.
    index : (rows, k) int array
        Columns that each row is regressed on.
    place : (rows, k, 2) int array
        Row and column of the structure that each of them estimates.
    used : (rows, k) bool array
        Which of the k are there; a row may have fewer.
    """

    rows: int
    size: int
    index: NDArray[np.intp]
    place: NDArray[np.intp]
    used: BoolArray

    @cached_property
    def width(self) -> int:
        """Number k of columns of the row with the most."""
        return self.index.shape[1]

    @cached_property
    def driven_by(self) -> NDArray[np.intp]:
        """Input that each instrument follows, (rows, k): itself, or else the row's main one."""
        main = _MAIN_INPUTS
        rows = np.array([*main, main[2], main[1]])[: self.rows]  # side force by rudder, lift by de
        own = self.index - INPUT_COLUMNS.start
        return np.where((own >= 0) & (own < len(INPUTS)), own, rows[:, None])

    @cached_property
    def main(self) -> NDArray[np.intp]:
        """Entry of the main input in each moment row, (3,)."""
        return np.array([self.index[i].tolist().index(j) for i, j in enumerate(MAIN_COLUMNS)])

    def main_effect(self, inputs: FloatArray, samples: RowSamples) -> FloatArray:
        """Return what main inputs with the derivatives `inputs` (3, 4) make in samples, (3, m)."""
        derivatives = inputs[_MOMENTS, _MAIN_INPUTS]
        return np.asarray(derivatives[:, None] * samples.f[_MOMENTS, :, self.main])

    @cached_property
    def _entries(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        return np.nonzero(self.used)[0], self.index[self.used]

    def matrix(self, linear: FloatArray) -> FloatArray:
        """Return coefficients (rows, k) in the place of their columns, shape (rows, c)."""
        matrix = np.zeros((self.rows, self.size))
        matrix[self._entries] = linear[self.used]
        return matrix


def differentiated_columns(structure: Structure) -> list[int]:
    """Columns of rates and inputs whose derivatives the force rows are regressed on, in order."""
    return sorted({j for flow in structure.flow for j in flow.others})


@lru_cache(maxsize=16)
def layout(structure: Structure) -> Layout:
    """Return the layout of the regression problem of a structure."""
    rows = [[(j, (i, j)) for j in np.flatnonzero(row)] for i, row in enumerate(structure.mask[:3])]
    size = structure.size
    if structure.has_flow:
        differentiated = differentiated_columns(structure)
        for k, flow in enumerate(structure.flow):
            first = size + len(structure.flow)
            rows.append(
                [
                    (size + k, (flow.force, flow.angle)),
                    *((first + differentiated.index(j), (flow.force, j)) for j in flow.others),
                    *((j, (flow.kinematics, j)) for j in flow.missing),
                ]
            )
        size += len(structure.flow) + len(differentiated)
    width = max(len(row) for row in rows)
    index = np.zeros((len(rows), width), dtype=np.intp)
    place = np.zeros((len(rows), width, 2), dtype=np.intp)
    used = np.zeros((len(rows), width), dtype=bool)
    for i, row in enumerate(rows):
        for k, (column, where) in enumerate(row):
            index[i, k], place[i, k], used[i, k] = column, where, True
    return Layout(len(rows), size, index, place, used)


@dataclass
class Regression:
    """Samples of the regression problem.

    Parameters
    ----------
    y : (m, rows) array
        Angular accelerations, filtered, rad/s^2; with flow angles also aydot, azdot, m/s^3.
    f : (m, c) array
        Regressors, filtered.
    z : (m, c) array
        Instruments: the regressors of the model's own state, filtered.
    dt : float
        Time that each sample stands for, s.
    restarted : bool
        Whether the first sample does not continue those before.
    injected : bool
        Whether the instruments are driven by what was injected on purpose alone.
    """

    y: FloatArray
    f: FloatArray
    z: FloatArray
    dt: float
    restarted: bool = False
    injected: bool = False

    @property
    def time(self) -> float:
        """Time that all samples together stand for, s."""
        return self.dt * len(self.y)

    def means(self) -> Regression:
        """Return the means over stretches of `SAMPLE_TIME`, or nearly."""
        m = len(self.y)
        count = min(m, max(1, round(self.time / SAMPLE_TIME)))
        begin, width = _parts(m, count)
        y, f, z = (np.add.reduceat(part, begin) / width for part in (self.y, self.f, self.z))
        return Regression(y, f, z, self.time / count, self.restarted, self.injected)

    def residual(self, coefficients: FloatArray) -> FloatArray:
        """Return ``e = y - A f`` of coefficients of shape (rows, c); shape (m, rows)."""
        return np.asarray(self.y - self.f @ coefficients.T)


class RowSamples:
    """Samples of the regression problem with what belongs to each row, side by side.

    Parameters
    ----------
    signals : (..., rows, m, 2 + 2 k) array
        Residual, y, the k regressors and the k instruments of each row; 0 where unused.
    dt : float
        Time that each sample stands for, s.

    Attributes
    ----------
    residual, y : (..., rows, m) array
        What the coefficients before left of y, and y: what is explained.
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
        """Return samples with residuals (m, rows), picked by the layout of their problem."""
        rows = cls(np.empty((layout.rows, len(residual), 2 + 2 * layout.width)), samples.dt)
        rows.residual[:], rows.y[:] = residual.T, samples.y.T
        for into, part in ((rows.f, samples.f), (rows.z, samples.z)):
            np.multiply(part.T[layout.index].swapaxes(1, 2), layout.used[:, None], out=into)
        return rows

    @classmethod
    def join(cls, parts: Sequence[RowSamples], newest: int) -> Self:
        """Return the newest of samples that follow one another."""
        signals = np.concatenate([part.signals for part in parts], axis=-2)
        return cls(signals[..., max(signals.shape[-2] - newest, 0) :, :], parts[-1].dt)

    def times(self, share: float) -> RowSamples:
        """Return the samples with their instruments times `share`."""
        rows = RowSamples(self.signals.copy(), self.dt)
        rows.z[:] *= share
        return rows

    def uninstrumented(self) -> RowSamples:
        """Return the samples with the regressors as their own instruments."""
        rows = RowSamples(self.signals.copy(), self.dt)
        rows.z[:] = rows.f
        return rows


@lru_cache(maxsize=64)
def _parts(m: int, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where `count` parts of m samples begin, and how many each has, (count, 1)."""
    begin = np.arange(count) * m // count
    return begin, np.diff(begin, append=m)[:, None]


class StateVariableFilter:
    """Filtered regressors, instruments and accelerations from the blocks of signals.

    At a restart the filters of what is differentiated start in equilibrium and all others from
    zero: then the equation holds from the first sample on, without a transient.

    Parameters
    ----------
    structure : Structure
        The structure of the model.
    cutoff : float
        Cut-off of the low-pass, rad/s.
    h : float
        Width of the cells, s.
    lever_arm : (3,) array
        Position of the accelerometer from the centre of gravity, m, FRD.
    """

    def __init__(
        self, structure: Structure, cutoff: float, h: float, lever_arm: FloatArray
    ) -> None:
        self._structure = structure
        self._lever = lever_arm_matrix(lever_arm)
        self._corrects_lever = bool(lever_arm.any()) and (
            structure.has_forces or structure.has_flow
        )
        n = structure.size
        self._cutoff = cutoff
        columns = differentiated_columns(structure)
        self._rates = [j for j in columns if j < INPUT_COLUMNS.start]
        self._surfaces = [j - INPUT_COLUMNS.start for j in columns if j >= INPUT_COLUMNS.start]
        # what is differentiated (rates, with flow angles also ay, az and their surfaces), f, and
        # what differs in z
        self._y = 5 + len(self._surfaces) if structure.has_flow else 3
        self._f = n + len(structure.flow)
        self._z = INPUT_COLUMNS.stop + 2 * len(structure.flow)
        self._filter = BlockFilter(low_pass(cutoff, h), self._y + self._f + self._z)

    def apply(
        self,
        block: Block,
        model_states: FloatArray,
        scale: FloatArray | None = None,
        coefficients: FloatArray | None = None,
        driven_by: FloatArray | None = None,
    ) -> Regression:
        """Filter one block.

        Parameters
        ----------
        block : Block
            Signals over m cells.
        model_states : (m + 1, 3 or 8) array
            State of the identified model at the edges.
        scale : (n,) array, optional
            Factor of each of the structure's regressors in the moment rows at the airspeed flown;
            one if left out.
        coefficients : (R, n) array, optional
            Those that the model ran with: they say what forces it makes.
        driven_by : (m, 4) array, optional
            Inputs that the model ran on: the part that was injected on purpose, where the
            instruments are to be free of feedback; all of them if left out.
        """
        inputs = block.u if driven_by is None else driven_by
        left, right = self._edges(block, model_states, inputs, coefficients)
        if scale is not None:
            self._scale(left, scale)
            self._scale(right, scale)
        if block.restarted:
            self._filter.state = np.zeros((2, left.shape[1]))
            self._filter.state[0, : self._y] = left[0, : self._y]
        states = without_negligible(self._filter.apply(left, right))
        injected = driven_by is not None
        if block.flow is None:
            return self._moments(states, block, injected=injected)
        return self._with_forces(states, block, block.flow.airspeed, scale, injected=injected)

    def _edges(
        self,
        block: Block,
        model_states: FloatArray,
        driven_by: FloatArray,
        coefficients: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray]:
        """Signals at the left and the right edges of the cells."""
        n, points = self._structure.size, len(block.x)
        both = self._structure.regressor(
            np.concatenate((block.x, model_states[:, :3])), np.zeros(len(INPUTS))
        )
        edges = np.empty((points, self._y + self._f + self._z))
        edges[:, :3] = block.x
        f = edges[:, self._y : self._y + self._f]
        z = edges[:, self._y + self._f :]
        f[:, :n] = both[:points]
        if n > CONSTANT_COLUMN:
            f[:, LAST_COLUMNS] = block.force
        z[:, STATE_COLUMNS] = both[points:, STATE_COLUMNS]
        flow = block.flow
        if flow is None:
            left, right = edges[:-1].copy(), edges[1:]
        else:
            assert coefficients is not None
            edges[:, 3:5] = block.force
            f[:, n:] = _turning(block.x, block.force, flow.down, flow.airspeed)
            made = _force_of_states(model_states, coefficients)
            turning = _turning(model_states, made, model_states[:, 5:], flow.airspeed)
            z[:, INPUT_COLUMNS.stop :] = np.concatenate((made, turning), axis=1)
            left, right = edges[:-1].copy(), edges[1:].copy()
            by_inputs = driven_by @ coefficients[3:5, INPUT_COLUMNS].T
            more = np.concatenate((by_inputs, by_inputs / flow.airspeed), axis=1)
            for side in (left, right):
                side[:, 5 : self._y] = block.u[:, self._surfaces]
                side[:, -more.shape[1] :] += more
        inputs = slice(self._y + INPUT_COLUMNS.start, self._y + INPUT_COLUMNS.stop)
        left[:, inputs] = right[:, inputs] = block.u
        inputs = slice(inputs.start + self._f, inputs.stop + self._f)
        left[:, inputs] = right[:, inputs] = driven_by
        return left, right

    def _scale(self, edge: FloatArray, scale: FloatArray) -> None:
        """Take regressors to the reference airspeed; forces stand for angles as they are."""
        f = edge[:, self._y : self._y + self._f]
        z = edge[:, self._y + self._f :]
        kept = CONSTANT_COLUMN + 1 if self._structure.has_flow else len(scale)
        f[:, :kept] *= scale[:kept]
        z[:, : INPUT_COLUMNS.stop] *= scale[: INPUT_COLUMNS.stop]
        if self._structure.has_flow:
            edge[:, 5 : self._y] *= scale[INPUT_COLUMNS][self._surfaces]
            f[:, -2:] *= scale[-1]
            z[:, -2:] *= scale[-1]

    def _moments(self, states: FloatArray, block: Block, *, injected: bool) -> Regression:
        """Regression problem of the moments alone, from the filters' states."""
        low, slope = states
        f = low[:, self._y : self._y + self._f]
        z = f.copy()
        z[:, : INPUT_COLUMNS.stop] = low[:, self._y + self._f :]
        y = slope[:, :3]
        if self._corrects_lever:
            f = f.copy()
            f[:, LAST_COLUMNS] -= y @ self._lever.T
        return Regression(y, f, z, block.h, block.restarted, injected)

    def _with_forces(
        self,
        states: FloatArray,
        block: Block,
        airspeed: float,
        scale: FloatArray | None,
        *,
        injected: bool,
    ) -> Regression:
        """Regression problem of moments and forces, from the filters' states."""
        low, slope = states
        n, known = self._structure.size, INPUT_COLUMNS.stop
        kinematics = slice(n, n + 2)
        rates = slice(n + 2, n + 2 + len(self._rates))
        low_z, slope_z = low[:, self._y + self._f :], slope[:, self._y + self._f :]
        y = slope[:, :5]
        turning = slope[:, [j - RATE_COLUMNS.start for j in self._rates]]
        if scale is not None:
            turning = turning * scale[self._rates]
        f = np.concatenate((low[:, self._y : self._y + self._f], turning, slope[:, 5 : self._y]), 1)
        z = f.copy()
        z[:, :known] = low_z[:, :known]
        z[:, LAST_COLUMNS] = low_z[:, known : known + 2]
        z[:, kinematics] = low_z[:, known + 2 :]
        z[:, rates] = slope_z[:, self._rates]
        if injected:
            z[:, rates.stop :] = slope_z[:, [INPUT_COLUMNS.start + j for j in self._surfaces]]
        if self._corrects_lever:
            y = y.copy()
            offset = y[:, :3] @ self._lever.T
            f[:, LAST_COLUMNS] -= offset
            f[:, kinematics] -= offset / airspeed
            y[:, 3:] -= self._jerk(low, slope, block) @ self._lever.T
        return Regression(y, f, z, block.h, block.restarted, injected)

    def _jerk(self, low: FloatArray, slope: FloatArray, block: Block) -> FloatArray:
        """Second derivative of the filtered rates, shape (m, 3), by the filter's own equation."""
        w = self._cutoff
        return np.asarray(w * w * (block.x[1:] - low[:, :3]) - np.sqrt(2.0) * w * slope[:, :3])


def _turning(x: FloatArray, force: FloatArray, down: FloatArray, v: float) -> FloatArray:
    """Rates of change of sideslip and angle of attack by their kinematics, (m, 2), rad/s."""
    turning = np.empty((len(x), 2))
    turning[:, 0] = (force[:, 0] + GRAVITY * down[:, 1]) / v - x[:, 2]
    turning[:, 1] = (force[:, 1] + GRAVITY * down[:, 2]) / v + x[:, 1]
    return turning


def _force_of_states(states: FloatArray, a: FloatArray) -> FloatArray:
    """Specific forces ay, az that the states of the model make, without inputs, (m, 2), m/s^2."""
    slopes = a[[3, 4], [LAST_COLUMNS.start, LAST_COLUMNS.start + 1]]
    return np.asarray(states[:, :3] @ a[3:5, RATE_COLUMNS].T + states[:, 3:5] * slopes)


def without_negligible(signals: FloatArray) -> FloatArray:
    """Return signals with zeros where they are negligible."""
    return np.where(np.abs(signals) < NEGLIGIBLE, 0.0, signals)
