# SPDX-License-Identifier: Apache-2.0
"""The model with angle of attack and sideslip, against SciPy's solution of its equations."""

from dataclasses import replace

import numpy as np
import pytest
from equations import AIRCRAFT, flown, matrix, with_down
from flying import blocks

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.model import (
    LARGEST_ANGLE,
    IdentifiedModel,
    plan_steps,
    with_measured_force,
)
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray

FLIGHT = STRUCTURES["flight_dynamics"]
RNG = np.random.default_rng(2)
SPEED = 18.0
A = matrix(FLIGHT, AIRCRAFT | {"pdot/dth": 0.5, "qdot/pp": -0.1, "qdot/rr": 0.1, "rdot/qr": 0.2})
START = np.array([0.3, -0.2, 0.1, 0.05, 0.04, 0.4, -0.1])
"""State: p, q, r, rad/s, beta, alpha, roll, pitch, rad."""


def block_of(u: FloatArray, h: float) -> Block:
    whole = np.tile(with_down(START), (len(u) + 1, 1))
    (block,) = blocks(whole[:, :3], u, h)
    return replace(block, state=whole, airspeed=SPEED)


@pytest.mark.parametrize("h", [0.001, 0.005, 0.0125, 0.025])
def test_a_run_over_a_block_is_the_solution_of_the_equations(h: float) -> None:
    """The width of the cells does not matter; inputs change every 50 ms, at the edge of a step."""
    u = np.repeat(RNG.uniform(-0.1, 0.1, (20, 4)), round(0.05 / h), axis=0)
    block = block_of(u, h)
    states = IdentifiedModel(FLIGHT, np.zeros(3)).run(A, block)
    state = START
    for k in range(20):
        state = flown(A, state, u[k * round(0.05 / h)], SPEED, 0.05)
        reached = states[(k + 1) * round(0.05 / h)]
        np.testing.assert_allclose(reached, with_down(state), atol=2e-5)


def test_a_strong_leak_keeps_the_model_near_the_measured_state() -> None:
    block = block_of(np.zeros((200, 4)), 0.005)
    model = IdentifiedModel(FLIGHT, np.zeros(3))
    free = model.run(A, block)[-1]
    leaky = model.run(A, block, leak_time=1e-2)[-1]
    measured = with_down(START)
    assert np.abs(leaky - measured).max() < 0.3 * np.abs(free - measured).max()


@pytest.mark.parametrize("name", ["qdot/alpha", "rdot/beta"])
def test_a_diverging_model_is_reset_to_the_measured_state(name: str) -> None:
    wild = A.copy()
    wild[FLIGHT.index(name)] *= -300.0
    block = block_of(np.zeros((200, 4)), 0.005)
    states = IdentifiedModel(FLIGHT, np.zeros(3)).run(wild, block)
    np.testing.assert_array_equal(states, block.state)
    beyond = block.state
    assert np.abs(beyond[:, 3:5]).max() < LARGEST_ANGLE


@pytest.mark.parametrize(("rate", "resets"), [(25.0, False), (-35.0, True)])
def test_a_model_that_turns_faster_than_30_rad_s_is_reset(rate: float, resets: bool) -> None:
    """A fast roll or spin is no divergence."""
    structure, x = STRUCTURES["augmented"], np.tile([rate, 0.0, 0.0], (41, 1))
    (block,) = blocks(x, np.zeros((40, 4)), 0.005)
    a = matrix(structure, {"pdot/1": 0.5})  # rad/s^2, for 0.2 s
    states = IdentifiedModel(structure, np.zeros(3)).run(a, block)
    np.testing.assert_allclose(states[-1], x[-1] + (0.0 if resets else [0.1, 0.0, 0.0]))


def test_at_the_start_the_leak_has_a_time_constant_of_half_a_second() -> None:
    """A step of the rates that no coefficient explains decays to 1/e."""
    identifier = OnlineIdentifier(Settings.from_values({"structure": "augmented"}))
    identifier.supervisor.adapt = False
    step, predicted = 2.0, {}
    for k in range(800):
        t = 0.005 * k
        t_ns = 10**9 + 5_000_000 * k
        identifier.add_rates(t_ns, (0.2 * (t >= step), 0.0, 0.0), (0.0, 0.0, -9.8))
        if k % 4 == 0:
            identifier.add_actuators(t_ns, (0.0,) * 4)
        predicted.update({e.t_ns * 1e-9 - 1.0: e.predicted_rates[0] for e in identifier.advance()})
    (left,) = [0.2 - p for t, p in predicted.items() if abs(t - step - 0.5) < 0.02]
    assert left == pytest.approx(0.2 / np.e, rel=0.1)


def test_without_a_force_slope_the_angles_moments_are_zero() -> None:
    unknown = A.copy()
    unknown[FLIGHT.index("ay/beta")] = 0.0
    without_beta = unknown[[0, 2]]
    without_beta[:, FLIGHT.column("beta")] = 0.0
    np.testing.assert_array_equal(with_measured_force(unknown, FLIGHT)[[0, 2]], without_beta)


@pytest.mark.parametrize(("h", "step"), [(0.005, 0.025), (0.0125, 0.025), (0.05, 0.05)])
def test_steps_of_25_ms_join_shorter_cells_and_split_longer_ones(h: float, step: float) -> None:
    plan = plan_steps(10, h)
    assert plan.times == pytest.approx([step] * round(10 * h / step))
    assert plan.split == round(step / 0.025)
