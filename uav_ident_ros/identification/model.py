# SPDX-License-Identifier: Apache-2.0
"""The model ``xdot = A f(x, u)``: its right-hand side, its integrator, and its run in flight.

Instruments, running fit, score, client and simulated plants all integrate this right-hand side. It
is plain arithmetic, which serves floats (one model, several times faster than arrays of three) as
well as arrays (thousands of prediction windows in parallel).

With sideslip and angle of attack as states, V is the airspeed, g gravity and d the unit vector
that points down, in body axes (``d = [-sin theta, sin phi cos theta, cos phi cos theta]``)::

    ay       = A_ay f,  az = A_az f
    betadot  = p alpha - r + (ay + g d_y) / V + A_betadot f
    alphadot = q - p beta + (az + g d_z) / V + A_alphadot f
    ddot     = d x [p q r]

(Stevens, Lewis and Johnson, Aircraft Control and Simulation, 2016, ch. 2, to first order in both
angles: a roll about the x axis turns one into the other.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from uav_ident_ros.identification.frames import lever_arm_matrix
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.scales import RESPONSE_TIME, STEP
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    EXOGENOUS_COLUMNS,
    INPUT_COLUMNS,
    LAST_COLUMNS,
    OWN_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    STATE_COLUMNS,
    FloatArray,
    Structure,
)

GRAVITY = 9.80665
"""Standard acceleration of gravity, m/s^2."""

SIDE_FORCE_SLOPE, LIFT_SLOPE = -15.0, -100.0
"""Initial `ay/beta` and `az/alpha`, m/s^2 per rad, with a standard deviation of the same size. In
level flight lift equals weight: ``az/alpha = -g C_La / C_L`` whatever the aircraft's size. C_La is
4 to 6 per rad, C_L 0.2 to 0.8. Fuselage and fin make a sixth of this as side force."""

LARGEST_RATE = 30.0
"""Rate beyond which the model's state has diverged, rad/s: no known aircraft turns faster."""

LARGEST_ANGLE = 0.5 * math.pi
"""Sideslip or angle of attack beyond which the state has diverged, rad."""

_ACROSS = np.repeat([0, 1, 2], 4), np.array([2, 3, 4, 6, 0, 1, 5, 7, 2, 3, 4, 6])
"""Coefficients that are zero for a body symmetric about its xz plane."""

Number = Any
"""A float, or an array of one value per trajectory."""

State = list[Number]
Derivative = Callable[..., State]
"""Right-hand side ``derivative(state, drive, slope, ahead)``: rate of change at the state
``state + ahead * slope``; `drive` is its part that does not depend on the state."""

Step = tuple[Any, Any, Any, Number]


def integrate(
    derivative: Derivative,
    state: State,  # Initial state: floats or (W,) arrays
    # For each step the drive at its beginning, middle and end, and its length, s
    steps: Iterable[Step],
) -> Iterator[State]:
    """Yield the state after each step, by the classical Runge-Kutta method of order 4."""
    for first, middle, last, dt in steps:
        half, sixth = 0.5 * dt, dt / 6.0
        k1 = derivative(state, first)
        k2 = derivative(state, middle, k1, half)
        k3 = derivative(state, middle, k2, half)
        k4 = derivative(state, last, k3, dt)
        state = [
            s + sixth * (a + 2.0 * (b + c) + d)
            for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
        ]
        yield state


def rates_derivative(
    a: FloatArray,  # (3, n) or (3, n, W) Coefficients; columns from the inputs on are not used
    leak: float = 0.0,  # One over the leak's time constant, 1/s
) -> Derivative:
    """Return the right-hand side for the state p, q, r.

    The drive is the part of pdot, qdot, rdot by inputs and forces, and the leak times the measured
    state.
    """
    moments = _moments(a, leak)

    def derivative(
        state: State, drive: Any, slope: State | None = None, ahead: Number = 0.0
    ) -> State:
        p, q, r = state
        if slope is not None:
            p, q, r = p + ahead * slope[0], q + ahead * slope[1], r + ahead * slope[2]
        pdot, qdot, rdot = moments(p, q, r)
        return [pdot + drive[0], qdot + drive[1], rdot + drive[2]]

    return derivative


def with_own(derivative: Derivative, a: FloatArray, structure: Structure) -> Derivative:
    """Return a right-hand side with the author's own regressors added.

    The drive then ends with the inputs de, dr, da, dth.
    """
    if not structure.own:
        return derivative
    terms = [
        (own.value, [row[OWN_COLUMNS.start + k] for row in _entries(a[: len(ROWS)])])
        for k, own in enumerate(structure.own)
    ]

    def extended(
        state: State, drive: Any, slope: State | None = None, ahead: Number = 0.0
    ) -> State:
        *first, de, dr, da, dth = drive
        rates = state[:3]
        if slope is not None:
            rates = [s + ahead * k for s, k in zip(rates, slope[:3], strict=True)]
        pdot, qdot, rdot, *others = derivative(state, first, slope, ahead)
        for value, (for_p, for_q, for_r) in terms:
            f = value(*rates, de, dr, da, dth)
            pdot, qdot, rdot = pdot + for_p * f, qdot + for_q * f, rdot + for_r * f
        return [pdot, qdot, rdot, *others]

    return extended


def _moments(a: FloatArray, leak: float) -> Callable[..., tuple[Number, Number, Number]]:
    """Return the part of pdot, qdot, rdot by the rates, as a function of p, q, r."""
    first, second, third = _entries(a[:3, STATE_COLUMNS])
    a1, a2, a3, a4, a5, a6, a7, a8 = first
    b1, b2, b3, b4, b5, b6, b7, b8 = second
    c1, c2, c3, c4, c5, c6, c7, c8 = third
    a6, b7, c8 = a6 - leak, b7 - leak, c8 - leak

    def symmetric(p: Number, q: Number, r: Number) -> tuple[Number, Number, Number]:
        pq, qr = p * q, q * r
        return (
            a1 * pq + a2 * qr + a6 * p + a8 * r,
            b3 * (p * r) + b4 * (p * p) + b5 * (r * r) + b7 * q,
            c1 * pq + c2 * qr + c6 * p + c8 * r,
        )

    if not a[_ACROSS].any():
        return symmetric

    def moments(p: Number, q: Number, r: Number) -> tuple[Number, Number, Number]:
        pq, qr, pr, pp, rr = p * q, q * r, p * r, p * p, r * r
        return (
            a1 * pq + a2 * qr + a3 * pr + a4 * pp + a5 * rr + a6 * p + a7 * q + a8 * r,
            b1 * pq + b2 * qr + b3 * pr + b4 * pp + b5 * rr + b6 * p + b7 * q + b8 * r,
            c1 * pq + c2 * qr + c3 * pr + c4 * pp + c5 * rr + c6 * p + c7 * q + c8 * r,
        )

    return moments


def flight_derivative(
    a: FloatArray,  # (7, n) or (7, n, W) Coefficients of a structure with flow angles
    leak: float = 0.0,  # As in `rates_derivative`
) -> Derivative:
    """Return the right-hand side for the state p, q, r, beta, alpha, d_x, d_y, d_z.

    The drive holds the parts of the seven rows that do not depend on the state, 1/V (s/m), and the
    terms added to the rate of change of d.
    """
    rows, moments = _entries(a), _moments(a, leak)
    beta_column, alpha_column = range(LAST_COLUMNS.start, LAST_COLUMNS.stop)
    l_beta, n_beta, y_beta = (rows[i][beta_column] for i in (0, 2, 3))
    m_alpha, z_alpha = (rows[i][alpha_column] for i in (1, 4))
    p_column, _, r_column = range(RATE_COLUMNS.start, RATE_COLUMNS.stop)
    y_p, y_r = rows[3][p_column], rows[3][r_column]
    beta_p = rows[5][p_column]

    def derivative(
        state: State, drive: Any, slope: State | None = None, ahead: Number = 0.0
    ) -> State:
        p, q, r, beta, alpha, dx, dy, dz = state
        if slope is not None:
            k1, k2, k3, k4, k5, k6, k7, k8 = slope
            p, q, r = p + ahead * k1, q + ahead * k2, r + ahead * k3
            beta, alpha = beta + ahead * k4, alpha + ahead * k5
            dx, dy, dz = dx + ahead * k6, dy + ahead * k7, dz + ahead * k8
        p0, q0, r0, ay0, az0, beta0, alpha0, per_speed, dx0, dy0, dz0 = drive
        pdot, qdot, rdot = moments(p, q, r)
        ay = y_beta * beta + y_p * p + y_r * r + ay0
        az = z_alpha * alpha + az0
        return [
            pdot + p0 + l_beta * beta,
            qdot + q0 + m_alpha * alpha,
            rdot + r0 + n_beta * beta,
            (ay + GRAVITY * dy) * per_speed - r + (alpha + beta_p) * p + beta0 - leak * beta,
            (az + GRAVITY * dz) * per_speed + q - beta * p + alpha0 - leak * alpha,
            dy * r - dz * q + dx0 - leak * dx,
            dz * p - dx * r + dy0 - leak * dy,
            dx * q - dy * p + dz0 - leak * dz,
        ]

    return derivative


def _entries(a: FloatArray) -> list[Any]:
    """Return rows of coefficients: floats of one model, (W,) arrays of many."""
    return a.tolist() if a.ndim == 2 else [list(row) for row in a]


def bounded(states: FloatArray) -> FloatArray:
    """Return states limited to `LARGEST_RATE`; NaN becomes a bound."""
    return np.asarray(np.fmin(np.fmax(states, -LARGEST_RATE), LARGEST_RATE))


def diverged(state: Sequence[float]) -> bool:
    """Whether a state is outside the range of an aircraft; NaN is."""
    for k, value in enumerate(state[:5]):
        if not abs(value) < (LARGEST_RATE if k < 3 else LARGEST_ANGLE):
            return True
    return False


def with_measured_force(coefficients: FloatArray, structure: Structure) -> FloatArray:
    """Return the moment rows with ay and az in the place of beta and alpha, shape (..., 3, n).

    ``beta = (ay - Y_p p - Y_r r - Y_dr dr) / Y_beta`` is substituted into the rows, and alpha
    likewise. Coefficients of other structures are returned unchanged.
    """
    if not structure.has_flow:
        return coefficients
    moments = coefficients[..., :3, :].copy()
    for flow in structure.flow:
        force = coefficients[..., flow.force, :]
        slope = force[..., flow.angle, None]
        share = moments[..., flow.angle] / np.where(slope == 0.0, np.inf, slope)
        moments -= share[..., None] * force[..., None, :]
        moments[..., flow.angle] = share
    return np.asarray(moments)


def off_centre(
    coefficients: FloatArray,  # (..., 3, n) A, with ay and az as its last regressors
    lever: FloatArray,  # (2, 3) L, m: see `lever_arm_matrix`
) -> FloatArray:
    """Return coefficients for forces measured by an offset accelerometer, (..., 3, n).

    With ``f = f_cg + L xdot`` the model ``xdot = A f_cg(...)`` is
    ``xdot = (I + A_f L)^-1 A f``, where A_f are the columns of ay and az.
    """
    forces = coefficients[..., LAST_COLUMNS]
    return np.asarray(np.linalg.solve(np.eye(3) + forces @ lever, coefficients))


class IdentifiedModel:
    """The identified model, which runs in parallel with the aircraft (eq. (3))."""

    def __init__(
        self,
        structure: Structure,
        lever_arm: FloatArray,  # (3,) From the centre of gravity to the accelerometer, m, FRD
    ) -> None:
        self._structure = structure
        self._lever = lever_arm_matrix(lever_arm)
        self._offset = bool(lever_arm.any()) and structure.has_forces
        self._form = flight_derivative if structure.has_flow else rates_derivative
        self._formed: tuple[bytes, float] | None = None  # Coefficients and leak of `_derivative`
        # xm: predicted p, q, r, rad/s, FRD; with flow angles beta, alpha, rad, and down as well
        self.state: FloatArray = np.zeros(8 if structure.has_flow else 3)

    def run(
        self,
        coefficients: FloatArray,  # (R, n) A_m
        block: Block,  # Measured signals over m cells
        leak_time: float = 0.0,  # Time constant of the leak to the measured state, s; 0 for none
    ) -> FloatArray:
        """Advance the state over a block; return it at the edges, (m + 1, 3 or 8)."""
        if block.restarted:
            self.state = block.state[0]
        states = self.propagate(coefficients, block, self.state, leak_time)
        if diverged(states[-1].tolist()):
            states = block.state
        self.state = states[-1]
        return states

    def respond(self, coefficients: FloatArray, block: Block, leak_time: float) -> FloatArray:
        """Advance the response to the injected part of the inputs alone; parameters as in `run`.

        It starts at rest, without gravity, constants, feedback or gusts.
        """
        assert block.excitation is not None
        coefficients = coefficients.copy()
        coefficients[:, CONSTANT_COLUMN : CONSTANT_COLUMN + 1] = 0.0
        alone = replace(
            block,
            state=np.zeros_like(block.state),
            u=block.excitation,
            specific_force=np.zeros_like(block.specific_force),
        )
        return self.run(coefficients, alone, leak_time)

    def propagate(
        self, coefficients: FloatArray, block: Block, start: FloatArray, leak_time: float = 0.0
    ) -> FloatArray:
        """Predict the state over a block from `start`; parameters as in `run`."""
        a = off_centre(coefficients, self._lever) if self._offset else coefficients
        leak = 1.0 / leak_time if leak_time > 0.0 else 0.0
        plan = plan_steps(len(block.u), block.h)
        # The part that does not depend on the state, a row for each step
        u = plan.cell_means @ block.u
        if block.airspeed is not None:
            drive = np.zeros((len(u), 11))
            drive[:, :7] = u @ a[:, INPUT_COLUMNS].T + a[:, CONSTANT_COLUMN]
            drive[:, 7] = 1.0 / block.airspeed
        else:
            exogenous = a[:, EXOGENOUS_COLUMNS]
            drive = u @ exogenous[:, :4].T
            if exogenous.shape[1] > 4:
                drive += exogenous[:, 4] + plan.means @ block.force @ exogenous[:, 5:].T
        if leak:
            pull = leak * (plan.means @ block.state)
            drive[:, :3] += pull[:, :3]
            drive[:, 5:7] += pull[:, 3:5]
            drive[:, 8:] += pull[:, 5:]
        if self._structure.own:
            drive = np.hstack((drive, u))
        # The coefficients are constant over some ticks.
        formed = a.tobytes(), leak
        if formed != self._formed:
            self._formed = formed
            self._derivative = with_own(self._form(a, leak), a, self._structure)
        cells, split = zip(drive.tolist(), plan.times, strict=True), plan.split
        steps = [(u, u, u, dt / split) for u, dt in cells for _ in range(split)]
        first = start.tolist()
        states = [first, *integrate(self._derivative, first, steps)]
        coarse = np.array(states[::split])
        if diverged(states[-1]):
            # Interpolation between infinite states would give NaN.
            coarse = bounded(coarse)
        return np.asarray(plan.lines @ coarse)

    def euler(
        self,
        coefficients: FloatArray,
        x: FloatArray,
        u: FloatArray,
        force: FloatArray,
        dt: float,
        leak_time: float,
    ) -> None:
        """Advance by one explicit Euler step of `dt` s, as in the paper."""
        f = self._structure.regressor(self.state, u, force)
        a = off_centre(coefficients, self._lever) if self._offset else coefficients
        state = self.state + dt * (a @ f)
        if leak_time > 0.0:
            state = state + min(dt / leak_time, 1.0) * (x - self.state)
        if diverged(state.tolist()):
            state = np.array(x)
        self.state = state


class Steps(NamedTuple):
    """The s integration steps over the m cells of a block."""

    times: list[float]  # Lengths of the steps, s
    split: int  # Number of substeps of a step, for cells longer than `STEP`
    cell_means: FloatArray  # (s, m) From values of the cells to means over the steps
    means: FloatArray  # (s, m + 1) From values at the cells' edges to means over the steps
    # (m + 1, s + 1) From values at the steps' edges to linear interpolation at the cells' edges
    lines: FloatArray


@lru_cache(maxsize=64)
def plan_steps(m: int, h: float) -> Steps:
    """Return the steps over `m` cells of `h` s: short cells are joined, long ones are split."""
    stride = max(1, round(STEP / h))
    begin = np.arange(0, m, stride)
    cells = np.minimum(stride, m - begin)
    step, edges = np.repeat(np.arange(len(begin)), cells), np.arange(m + 1)
    cell_means = np.zeros((len(begin), m))
    cell_means[step, edges[:-1]] = 1.0 / cells[step]
    means = np.zeros((len(begin), m + 1))
    means[:, :-1] = 0.5 * cell_means
    means[:, 1:] += 0.5 * cell_means
    left = np.append(step, len(begin) - 1)
    share = (edges - begin[left]) / cells[left]
    lines = np.zeros((m + 1, len(begin) + 1))
    lines[edges, left], lines[edges, left + 1] = 1.0 - share, share
    return Steps((cells * h).tolist(), max(1, round(h / STEP)), cell_means, means, lines)


class ParallelModel:
    """The identified model beside the aircraft, and the instruments that follow from it.

    Its states contain neither gyro noise nor gusts. During injection its response to the injected
    signals only is free of feedback, too.
    """

    def __init__(self, structure: Structure, lever_arm: FloatArray) -> None:
        self.model = IdentifiedModel(structure, lever_arm)
        self._response = IdentifiedModel(structure, lever_arm)
        self._since_injected = RESPONSE_TIME

    def follow(
        self,
        block: Block,  # Measured signals over m cells; its flow angles are known
        coefficients: FloatArray,  # (R, n) A_m at the airspeed flown
        leak_time: float,  # Of the leak towards the measured state, s; 0 for none
    ) -> None:
        """Run the model over a block, and add its state, from which instruments follow."""
        block.model_state = self.model.run(coefficients, block, leak_time)
        self._since_injected += block.time
        if block.excitation is not None and block.excitation.any():
            self._since_injected = 0.0
        block.injected = block.excitation is not None and self._since_injected < RESPONSE_TIME
        if block.injected:
            block.model_state = self._response.respond(coefficients, block, leak_time)
