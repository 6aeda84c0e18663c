# SPDX-License-Identifier: Apache-2.0
"""The identified model xm_dot = A_m f(xm, u), run beside the aircraft (eq. (3))."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.frames import lever_arm_matrix
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.structure import (
    EXOGENOUS_COLUMNS,
    INPUT_COLUMNS,
    SPECIFIC_FORCES,
    FloatArray,
    Structure,
)

STEP = 0.01
"""Integration step aimed at, s: with the fastest roll mode of a small aircraft, 50 ms, the
midpoint rule then errs by less than 1 %. Shorter cells are joined, longer ones are cut."""

LARGEST_RATE = 30.0
"""Rate beyond which the model's state has diverged, rad/s: no aircraft here turns faster."""


class IdentifiedModel:
    """State of the identified model.

    Parameters
    ----------
    structure : Structure
        Regressors and coefficients.
    lever_arm : (3,) array
        Position of the accelerometer from the centre of gravity, m, FRD.

    Attributes
    ----------
    state : (3,) array
        xm: predicted p, q, r, rad/s, FRD.
    resets : int
        How often the state diverged and was set back to the measured rates.
    """

    def __init__(self, structure: Structure, lever_arm: FloatArray) -> None:
        self._structure = structure
        self._lever = lever_arm_matrix(lever_arm)
        self._offset = bool(lever_arm.any()) and structure.size > INPUT_COLUMNS.stop
        self.state: FloatArray = np.zeros(3)
        self.resets = 0

    def restart(self, x: FloatArray) -> None:
        """Set the state to the rates `x`."""
        self.state = np.array(x, dtype=np.float64)

    def effective(self, coefficients: FloatArray) -> FloatArray:
        """Coefficients for specific forces as measured by an offset accelerometer.

        With ``f = f_cg + L xdot`` the model ``xdot = A f_cg(...)`` is
        ``xdot = (I + A_f L)^-1 A f``, where A_f are the columns of ay and az.
        """
        if not self._offset:
            return coefficients
        force_columns = coefficients[:, -len(SPECIFIC_FORCES) :]
        return np.asarray(np.linalg.solve(np.eye(3) + force_columns @ self._lever, coefficients))

    def run(self, coefficients: FloatArray, block: Block, leak_time: float) -> FloatArray:
        """Advance the state over a block.

        Parameters
        ----------
        coefficients : (3, n) array
            A_m.
        block : Block
            Measured signals over m cells.
        leak_time : float
            Time constant of the pull towards the measured rates, s; 0 for none.

        Returns
        -------
        (m + 1, 3) array
            The state at the edges, rad/s.
        """
        states = self.propagate(coefficients, block, self.state, leak_time)
        if not (np.abs(states[-1]) < LARGEST_RATE).all():  # NaN fails too
            self.resets += 1
            states = block.x.copy()
        self.state = states[-1]
        return states

    def propagate(
        self, coefficients: FloatArray, block: Block, x0: FloatArray, leak_time: float = 0.0
    ) -> FloatArray:
        """Predict the rates over a block from `x0`, shape (3,); parameters as in `run`."""
        a = self.effective(coefficients)
        drive = self._drive(a, block)
        leak = 1.0 / leak_time if leak_time > 0.0 else 0.0
        if leak:
            drive = drive + leak * 0.5 * (block.x[:-1] + block.x[1:])
        stride = max(1, round(STEP / block.h))
        return _integrate(a, x0, drive, block.h, stride, leak)

    def euler(
        self,
        coefficients: FloatArray,
        x: FloatArray,
        u: FloatArray,
        force: FloatArray,
        dt: float,
        leak_time: float,
    ) -> None:
        """Advance by one explicit Euler step of `dt` s, as the paper does.

        Parameters are those of `run`, with the inputs at the tick.
        """
        f = self._structure.regressor(self.state, u, force)
        state = self.state + dt * (self.effective(coefficients) @ f)
        if leak_time > 0.0:
            state = state + min(dt / leak_time, 1.0) * (x - self.state)
        if not (np.abs(state) < LARGEST_RATE).all():  # NaN fails too
            self.resets += 1
            state = np.array(x)
        self.state = state

    def _drive(self, a: FloatArray, block: Block) -> FloatArray:
        """Part of xdot that does not depend on the state: inputs, constant, forces; (m, 3)."""
        exogenous = a[:, EXOGENOUS_COLUMNS]
        drive = block.u @ exogenous[:, :4].T
        if exogenous.shape[1] > 4:
            force = 0.5 * (block.force[:-1] + block.force[1:])
            drive = drive + exogenous[:, 4] + force @ exogenous[:, 5:].T
        return np.asarray(drive)


def _integrate(
    a: FloatArray, x0: FloatArray, drive: FloatArray, h: float, stride: int, leak: float
) -> FloatArray:
    """Midpoint rule over the cells, `stride` cells a step; straight lines between the steps.

    Plain floats: for three states they are several times faster than arrays.
    """
    xdot = _acceleration(a, leak)
    steps = _steps(len(drive), stride)
    if stride > 1:
        drive = np.add.reduceat(drive, steps.begin) / steps.cells[:, None]
    per_cell = max(1, round(h / STEP))
    p, q, r = x0.tolist()
    states = [(p, q, r)]
    for (bp, bq, br), dt in zip(
        drive.tolist(), (steps.cells * (h / per_cell)).tolist(), strict=True
    ):
        half = 0.5 * dt
        for _ in range(per_cell):
            dp, dq, dr = xdot(p, q, r)
            mp, mq, mr = xdot(p + half * (dp + bp), q + half * (dq + bq), r + half * (dr + br))
            p, q, r = p + dt * (mp + bp), q + dt * (mq + bq), r + dt * (mr + br)
        states.append((p, q, r))
    coarse = np.array(states)
    if not abs(p) + abs(q) + abs(r) < LARGEST_RATE:  # NaN fails too
        # Diverged is diverged: what lies between infinite states would be no number.
        coarse = np.clip(coarse, -2.0 * LARGEST_RATE, 2.0 * LARGEST_RATE)
    if stride == 1:
        return coarse
    low = coarse[steps.left]
    return np.asarray(low + steps.share * (coarse[steps.left + 1] - low))


@dataclass(frozen=True)
class _Steps:
    """Integration steps over the m cells of a block.

    Parameters
    ----------
    begin : (s,) int array
        First cell of each step.
    cells : (s,) array
        Cells of each step.
    left : (m + 1,) int array
        Step in which each edge lies.
    share : (m + 1, 1) array
        How far through it, 0 ... 1.
    """

    begin: NDArray[np.intp]
    cells: FloatArray
    left: NDArray[np.intp]
    share: FloatArray


@lru_cache(maxsize=64)
def _steps(m: int, stride: int) -> _Steps:
    begin = np.arange(0, m, stride)
    cells = np.minimum(stride, m - begin) * 1.0
    edges = np.arange(m + 1)
    left = np.minimum(edges // stride, len(begin) - 1)
    return _Steps(begin, cells, left, ((edges - begin[left]) / cells[left])[:, None])


def _acceleration(
    a: FloatArray, leak: float
) -> Callable[[float, float, float], tuple[float, float, float]]:
    """Return the part of A f that depends on the state, less the leak, as a function of it."""
    first, second, third = a[:, : INPUT_COLUMNS.start].tolist()
    a1, a2, a3, a4, a5, a6, a7, a8 = first
    b1, b2, b3, b4, b5, b6, b7, b8 = second
    c1, c2, c3, c4, c5, c6, c7, c8 = third
    a6, b7, c8 = a6 - leak, b7 - leak, c8 - leak

    def xdot(p: float, q: float, r: float) -> tuple[float, float, float]:
        pq, qr, pr, pp, rr = p * q, q * r, p * r, p * p, r * r
        return (
            a1 * pq + a2 * qr + a3 * pr + a4 * pp + a5 * rr + a6 * p + a7 * q + a8 * r,
            b1 * pq + b2 * qr + b3 * pr + b4 * pp + b5 * rr + b6 * p + b7 * q + b8 * r,
            c1 * pq + c2 * qr + c3 * pr + c4 * pp + c5 * rr + c6 * p + c7 * q + c8 * r,
        )

    return xdot
