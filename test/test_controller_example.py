# SPDX-License-Identifier: Apache-2.0
"""The law of the example controller on linear plants: what the loop can stand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the example is a ROS node")

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.controller_example import RateLaw
from uav_ident_ros.identification.structure import INPUT_COLUMNS, STRUCTURES, FloatArray

STRUCTURE = STRUCTURES["baseline"]
DT_NS = 10_000_000
DELAY_STEPS = 2
START = 1_700_000_000 * 10**9
LIMITS = np.array([[-0.4, -0.3, -0.3, 0.0], [0.4, 0.3, 0.3, 1.0]])


def model(effect: float = 1.0) -> AttitudeModel:
    values = np.zeros(STRUCTURE.mask.shape)
    for name, value in {
        "pdot/p": -6.4, "pdot/da": 29.5, "qdot/q": -5.5, "qdot/de": -26.0,
        "rdot/r": -0.5, "rdot/dr": -4.3, "rdot/p": -0.3, "pdot/dr": 3.0, "pdot/pq": 0.2,
    }.items():  # fmt: skip
        values[STRUCTURE.index(name)] = value
    values[:, INPUT_COLUMNS] *= effect
    return AttitudeModel(STRUCTURE, values, np.ones_like(values, dtype=bool))


def flown(
    known: AttitudeModel, plant: AttitudeModel, reference: FloatArray, seconds: float = 4.0,
    disturbance: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> FloatArray:  # fmt: skip
    """Rates of a plant that is stepped to `reference`, with two samples of delay."""
    law = RateLaw(LIMITS, DELAY_STEPS * DT_NS * 1e-9)
    x, underway, rates = np.zeros(3), [np.zeros(4)] * DELAY_STEPS, []
    for k in range(round(seconds * 1e9 / DT_NS)):
        rates.append(x)
        wanted = reference if k * DT_NS > 500_000_000 else np.zeros(3)
        underway.append(law.update(START + k * DT_NS, known, x, wanted))
        u = underway.pop(0)
        for _ in range(10):
            x = x + DT_NS * 1e-10 * (plant.acceleration(x, u) + np.array(disturbance))
    return np.array(rates)


STEP = np.array([0.3, 0.1, 0.05])


def test_it_follows_a_step_without_overshoot_to_speak_of() -> None:
    rates = flown(model(), model(), STEP)
    np.testing.assert_allclose(rates[-1], STEP, atol=1e-3)
    assert (rates.max(axis=0) < 1.15 * STEP).all()
    after_half_a_second = rates[100]
    assert (after_half_a_second[:2] > 0.85 * STEP[:2]).all()


def test_a_steady_disturbance_leaves_no_error() -> None:
    rates = flown(model(), model(), np.zeros(3), disturbance=(1.0, -0.5, 0.2))
    assert np.abs(rates).max() > 0.02
    np.testing.assert_allclose(rates[-1], 0.0, atol=1e-3)


@pytest.mark.parametrize("effect", [0.5, 1.6])
def test_it_stands_a_surface_of_half_and_of_half_as_much_again_effect(effect: float) -> None:
    """What the last good set is after a fault: wrong, but stable and exact in the end."""
    rates = flown(model(), model(effect), STEP, seconds=8.0)
    np.testing.assert_allclose(rates[-1], STEP, atol=5e-3)
    assert (rates.max(axis=0) < 1.6 * STEP).all()


def test_the_right_model_follows_better_than_one_of_twice_the_effect() -> None:
    errors = [
        np.sqrt(np.mean((flown(known, model(0.5), STEP)[50:] - STEP) ** 2, axis=0))
        for known in (model(0.5), model())
    ]
    assert (errors[0][:2] < 0.8 * errors[1][:2]).all()


def test_a_new_model_moves_no_surface_at_once() -> None:
    """Steady rates held with a model of twice the effect; then the right one comes."""
    law, true = RateLaw(LIMITS, 0.0), model(0.5)
    x, u, t_ns = np.zeros(3), np.zeros(4), START
    for _ in range(800):
        t_ns += DT_NS
        u = law.update(t_ns, model(), x, STEP)
        x = x + DT_NS * 1e-9 * true.acceleration(x, u)
    np.testing.assert_allclose(x, STEP, atol=1e-3)
    after = law.update(t_ns + DT_NS, true, x, STEP)
    np.testing.assert_allclose(after, u, atol=2e-3)


def test_after_a_gap_it_starts_afresh() -> None:
    law = RateLaw(LIMITS, 0.02)
    for k in range(200):
        law.update(START + k * DT_NS, model(), np.array([0.3, 0.0, 0.0]), np.zeros(3))
    fresh = RateLaw(LIMITS, 0.02).update(START, model(), np.array([0.1, 0.0, 0.0]), np.zeros(3))
    late = law.update(START + 10**10, model(), np.array([0.1, 0.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(late, fresh)
