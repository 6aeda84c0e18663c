# SPDX-License-Identifier: Apache-2.0
"""The regression problem of a tick: y = A f, sample by sample.

State-variable filter: with the same low-pass H(s) on every regressor and s H(s) on the rates,
``s H x = A H f(x, u)`` holds exactly for every plant of the structure, and nothing is ever
differentiated (Young 1981; Garnier and Wang 2008, ch. 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.filters import BlockFilter, low_pass
from uav_ident_ros.identification.frames import lever_arm_matrix
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    SPECIFIC_FORCES,
    FloatArray,
    Structure,
)

STATE_COLUMNS = slice(0, INPUT_COLUMNS.start)
"""Regressors made of rates: those in which an instrument differs from the regressor."""

NEGLIGIBLE = 1e-30
"""Magnitude below which a signal counts as zero, SI: no sensor resolves it, and the square of
its square must be a number still."""


@dataclass(frozen=True)
class Regression:
    """Samples of the regression problem.

    Parameters
    ----------
    y : (m, 3) array
        Angular accelerations, filtered, rad/s^2.
    f : (m, n) array
        Regressors, filtered.
    z : (m, n) array
        Instruments: the regressors of the model's own state, filtered.
    dt : float
        Time that each sample stands for, s.
    restarted : bool
        Whether the first sample does not continue those before.
    """

    y: FloatArray
    f: FloatArray
    z: FloatArray
    dt: float
    restarted: bool = False

    @property
    def time(self) -> float:
        """Time that all samples together stand for, s."""
        return self.dt * len(self.y)

    def residual(self, coefficients: FloatArray) -> FloatArray:
        """Return ``e = y - A f`` of coefficients of shape (3, n); shape (m, 3), rad/s^2."""
        return np.asarray(self.y - self.f @ coefficients.T)


class StateVariableFilter:
    """Filtered regressors, instruments and accelerations from the blocks of signals.

    At a restart the filter of the rates starts in equilibrium and all others from zero: then
    the equation holds from the first sample on, without a transient.

    Parameters
    ----------
    structure : Structure
        The regressors.
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
        self._corrects_lever = bool(lever_arm.any()) and structure.size > INPUT_COLUMNS.stop
        self._channels = 3 + structure.size + STATE_COLUMNS.stop
        self._filter = BlockFilter(low_pass(cutoff, h), self._channels)

    def apply(
        self, block: Block, model_states: FloatArray, scale: FloatArray | None = None
    ) -> Regression:
        """Filter one block.

        Parameters
        ----------
        block : Block
            Signals over m cells.
        model_states : (m + 1, 3) array
            State of the identified model at the edges, rad/s.
        scale : (n,) array, optional
            Factor of each regressor at the airspeed flown; one if left out.
        """
        n = self._structure.size
        if block.restarted:
            self._filter.state = np.zeros((2, self._channels))
            self._filter.state[0, :3] = block.x[0]
        edges = self._edges(block, model_states)
        left, right = edges[:-1].copy(), edges[1:]
        inputs = slice(3 + INPUT_COLUMNS.start, 3 + INPUT_COLUMNS.stop)
        left[:, inputs] = right[:, inputs] = block.u
        if scale is not None:
            for edge in (left, right):
                edge[:, 3 : 3 + n] *= scale
                edge[:, 3 + n :] *= scale[STATE_COLUMNS]
        states = without_negligible(self._filter.apply(left, right))
        y = states[1, :, :3]
        f = states[0, :, 3 : 3 + n]
        z = f.copy()
        z[:, STATE_COLUMNS] = states[0, :, 3 + n :]
        if self._corrects_lever:
            f = f.copy()
            f[:, -len(SPECIFIC_FORCES) :] -= y @ self._lever.T
        return Regression(y, f, z, block.h, block.restarted)

    def _edges(self, block: Block, model_states: FloatArray) -> FloatArray:
        """Signals at the edges of the cells, but for the inputs: rates, regressors, instruments."""
        n, points = self._structure.size, len(block.x)
        both = self._structure.regressor(np.concatenate((block.x, model_states)), _NO_INPUT)
        edges = np.empty((points, self._channels))
        edges[:, :3] = block.x
        edges[:, 3 : 3 + n] = both[:points]
        edges[:, 3 + n :] = both[points:, STATE_COLUMNS]
        if n > INPUT_COLUMNS.stop:
            edges[:, 3 + n - len(SPECIFIC_FORCES) : 3 + n] = block.force
        return edges


def without_negligible(signals: FloatArray) -> FloatArray:
    """Return signals with zeros where they are negligible."""
    return np.where(np.abs(signals) < NEGLIGIBLE, 0.0, signals)


_NO_INPUT: FloatArray = np.zeros(len(INPUTS))
