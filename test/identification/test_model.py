# SPDX-License-Identifier: Apache-2.0
"""The model with angle of attack and sideslip: against SciPy and its own linearisation."""

from __future__ import annotations

import numpy as np
import pytest
from equations import flight_equations, slope
from scipy.integrate import solve_ivp

from uav_ident_ros.identification.linearisation import Condition, linearise
from uav_ident_ros.identification.model import (
    LARGEST_ANGLE,
    FlowSignals,
    IdentifiedModel,
    flight_derivative,
    with_measured_force,
)
from uav_ident_ros.identification.prior import slope_bounds, start_from
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.light_aircraft import SPEED, TRUTH

FLIGHT, AUGMENTED = STRUCTURES["flight_dynamics"], STRUCTURES["augmented"]
RNG = np.random.default_rng(2)


def coefficients() -> FloatArray:
    """The light aircraft, with rate products, throttle and biases."""
    values = np.zeros(FLIGHT.mask.shape)
    for name, value in {
        **TRUTH, "pdot/qr": -0.7, "pdot/pq": 0.1, "qdot/pr": 0.85, "qdot/pp": -0.1, "qdot/rr": 0.1,
        "rdot/pq": -0.25, "rdot/qr": 0.2, "pdot/dth": 0.5, "qdot/dth": -1.0, "rdot/dth": -0.5,
        "pdot/1": 0.1, "qdot/1": 2.0, "rdot/1": -0.1, "betadot/1": 0.02, "alphadot/1": -0.03,
        "betadot/p": 0.07, "ay/p": -0.25, "ay/r": 0.6,
    }.items():  # fmt: skip
        values[FLIGHT.index(name)] = value
    return values


A = coefficients()
START = np.array([0.3, -0.2, 0.1, 0.05, 0.04, 0.4, -0.1])
"""p, q, r, beta, alpha, roll, pitch."""


def with_down(state: FloatArray) -> FloatArray:
    """The model's own state, with the direction of down for roll and pitch."""
    *first, roll, pitch = state
    level = np.cos(pitch)
    return np.array([*first, -np.sin(pitch), np.sin(roll) * level, np.cos(roll) * level])


def drive(u: FloatArray) -> list[float]:
    rows = A[:, 8:12] @ u + A[:, 12]
    return [*rows.tolist(), 1.0 / SPEED, 0.0, 0.0, 0.0]


def test_the_right_hand_side_is_that_by_hand() -> None:
    u = np.array([0.05, -0.02, 0.03, 0.2])
    found = flight_derivative(A)(with_down(START).tolist(), drive(u))
    expected = flight_equations(A, START, u, SPEED)
    np.testing.assert_allclose(found[:5], expected[:5], atol=1e-12)
    np.testing.assert_allclose(found, slope(with_down, START) @ expected, atol=1e-8)


def test_the_linearisation_is_the_slope_of_the_right_hand_side() -> None:
    u = np.array([0.05, -0.02, 0.03, 0.2])
    p, q, r, *_, roll, pitch = START.tolist()
    a, b = linearise(FLIGHT, A, Condition(SPEED, (p, q, r), roll, pitch))

    at = np.concatenate([START, u])
    expected = slope(lambda x: flight_equations(A, x[:7], x[7:], SPEED), at)[:6]
    np.testing.assert_allclose(np.hstack([a, b]), np.delete(expected, 6, axis=1), atol=1e-6)


def test_many_models_side_by_side_are_each_the_one() -> None:
    many = A[..., None] * RNG.uniform(0.5, 1.5, (1, 1, 5))
    states = with_down(START)[:, None] * RNG.uniform(0.9, 1.1, (8, 5))
    u = np.array([0.05, -0.02, 0.03, 0.2])
    rows = np.einsum("ijw,j->iw", many[:, 8:12], u) + many[:, 12]
    shared = [*rows, 1.0 / SPEED, 0.0, 0.0, 0.0]
    together = np.array(flight_derivative(many)(list(states), shared))
    for k in range(5):
        alone = [*rows[:, k].tolist(), 1.0 / SPEED, 0.0, 0.0, 0.0]
        one = flight_derivative(many[..., k])(states[:, k].tolist(), alone)
        np.testing.assert_allclose(together[:, k], one, rtol=1e-12)


def block_of(u: FloatArray, h: float, *, restarted: bool = True) -> tuple[Block, FlowSignals]:
    m = len(u)
    t_ns = np.rint(np.arange(m + 1) * h * 1e9).astype(np.int64)
    x = np.tile(START[:3], (m + 1, 1))
    block = Block(t_ns, h, x, u, np.zeros((m + 1, 3)), restarted)
    whole = np.tile(with_down(START), (m + 1, 1))
    return block, FlowSignals(whole[:, 3:5], whole[:, 5:], SPEED)


@pytest.mark.parametrize("h", [0.001, 0.005, 0.0125, 0.025])
def test_a_run_over_a_block_is_the_solution_of_the_equations(h: float) -> None:
    """Whatever the width of the cells; inputs change every 50 ms, where no step crosses."""
    u = np.repeat(RNG.uniform(-0.1, 0.1, (20, 4)), round(0.05 / h), axis=0)
    block, flow = block_of(u, h)
    states = IdentifiedModel(FLIGHT, np.zeros(3)).run(A, block, flow)
    state = START
    for k in range(20):
        held = u[k * round(0.05 / h)]
        state = solve_ivp(
            lambda _, s, held=held: flight_equations(A, s, held, SPEED),
            (0.0, 0.05),
            state,
            rtol=1e-10,
            atol=1e-12,
        ).y[:, -1]
        reached = states[(k + 1) * round(0.05 / h)]
        np.testing.assert_allclose(reached, with_down(state), atol=2e-5)


def test_a_strong_leak_stays_with_what_was_measured() -> None:
    block, flow = block_of(np.zeros((200, 4)), 0.005)
    model = IdentifiedModel(FLIGHT, np.zeros(3))
    free = model.run(A, block, flow)[-1]
    leaky = model.run(A, block, flow, leak_time=1e-2)[-1]
    measured = with_down(START)
    assert np.abs(leaky - measured).max() < 0.3 * np.abs(free - measured).max()


@pytest.mark.parametrize("name", ["qdot/alpha", "rdot/beta"])
def test_a_model_that_diverges_is_set_back_to_what_was_measured(name: str) -> None:
    wild = A.copy()
    wild[FLIGHT.index(name)] *= -300.0
    block, flow = block_of(np.zeros((200, 4)), 0.005)
    model = IdentifiedModel(FLIGHT, np.zeros(3))
    states = model.run(wild, block, flow)
    assert model.resets == 1
    np.testing.assert_array_equal(states, flow.at_edges(block.x))
    beyond = flow.at_edges(block.x)
    assert np.abs(beyond[:, 3:5]).max() < LARGEST_ANGLE


def test_with_measured_forces_the_moments_are_the_same() -> None:
    """The flow angles at which the force rows give the measured forces, put into the moments."""
    with_force = with_measured_force(A, FLIGHT)
    assert with_force.shape == (3, FLIGHT.size)
    for _ in range(20):
        x, u, angles = RNG.normal(size=3), RNG.normal(size=4), RNG.normal(size=2)
        rows = A @ FLIGHT.regressor(x, u, angles)
        measured = FLIGHT.regressor(x, u, rows[3:5])
        np.testing.assert_allclose(with_force @ measured, rows[:3], atol=1e-9)
    batch = np.stack([A, 2.0 * A])
    np.testing.assert_allclose(with_measured_force(batch, FLIGHT)[0], with_force)
    assert with_measured_force(A[:3], AUGMENTED) is not None
    np.testing.assert_array_equal(with_measured_force(A[:3], AUGMENTED), A[:3])


def test_a_force_row_of_nothing_leaves_no_moment_of_its_angle() -> None:
    unknown = A.copy()
    unknown[FLIGHT.index("ay/beta")] = 0.0
    with_force = with_measured_force(unknown, FLIGHT)
    assert np.isfinite(with_force).all()
    assert not with_force[[0, 2], FLIGHT.column("beta")].any()


def test_the_start_never_divides_by_a_slope_that_cannot_be() -> None:
    """A zero in the initial coefficients says that nothing is known, not that there is no lift."""
    for given in (0.0, 5.0):
        values = np.full((5, FLIGHT.size), given)
        start = start_from(
            Settings.from_values({"initial_coefficients": tuple(values.ravel().tolist())})
        )
        for name in ("ay/beta", "az/alpha"):
            assert start.values[FLIGHT.index(name)] == slope_bounds(FLIGHT)[FLIGHT.index(name)] < 0
