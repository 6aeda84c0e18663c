# SPDX-License-Identifier: Apache-2.0
"""Turning flight: gyro and specific force show the direction and speed of flight."""

import math
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from flying import identified, light_measured

from uav_ident_ros.identification import turning
from uav_ident_ros.identification.frames import rotations
from uav_ident_ros.identification.scales import LONG_MEMORY
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.identification.turning import Turns, forward_speed

TICK = 0.05


@cache
def circling(speed: float, seconds: float = turning.WINDOW) -> tuple[FloatArray, ...]:
    """Return times, rates and specific forces of a steady turn with a slow pitching motion."""
    t = TICK * np.arange(1, round(seconds / TICK) + 1)
    rates = np.stack([0.1 * np.cos(t), 0.1 + 0.2 * np.sin(0.7 * t), np.full_like(t, 0.3)], axis=1)
    attitude, down, force = np.eye(3), np.array([0.0, 0.0, 9.80665]), []
    for rate in rates:
        turn = rotations(rate[None] * TICK)[0]
        now = attitude @ turn
        change = (now - attitude)[:, 0] * speed / TICK  # of the velocity, initial axes
        force.append(now.T @ (change - down))
        attitude = now
    return t, rates, np.array(force)


@pytest.mark.parametrize("speed", [20.0, -20.0, 120.0])
def test_the_speed_of_a_steady_turn_is_exact(speed: float) -> None:
    found, variance, _ = forward_speed(*circling(speed))
    assert found == pytest.approx(speed, rel=1e-9)
    assert math.sqrt(variance) < 1e-6 * abs(speed)


def test_flight_without_turns_shows_no_speed() -> None:
    t, rates, force = circling(20.0)
    variance = forward_speed(t, np.zeros_like(rates), force).variance
    assert variance == math.inf
    turns = Turns()
    assert turns.speed == (0.0, math.inf)
    turns.add(t, np.zeros_like(rates), force)
    assert turns.speed == (0.0, math.inf)


def test_sigma_covers_a_drift_of_the_flow_angles() -> None:
    """Velocities that are independent after one second, 1 m/s rms, in each axis."""
    rng, errors = np.random.default_rng(1), []
    t, rates, force = circling(20.0)
    for _ in range(200):
        drift = np.repeat(rng.normal(0.0, 1.0, (round(turning.WINDOW), 3)), 20, axis=0)
        spoilt = force + np.diff(drift, axis=0, prepend=drift[:1]) / TICK
        found, variance, _ = forward_speed(t, rates, spoilt)
        errors.append(abs(found - 20.0) / math.sqrt(variance))
    assert 0.6 <= np.mean(np.array(errors) < 1.0) <= 0.8
    assert 0.92 <= np.mean(np.array(errors) < 2.0) <= 0.99


def test_fits_that_overlap_count_once() -> None:
    """Two minutes of fits at every step have the weight of the memory, a minute."""
    t, rates, force = circling(20.0)
    force = force + np.random.default_rng(1).normal(0.0, 2.0, force.shape)
    turns, variance = Turns(), forward_speed(t, rates, force).variance
    for _ in range(round(120.0 / turning.STEP)):
        turns.add(t, rates, force)
    windows = LONG_MEMORY / turning.WINDOW
    assert turns.speed[1] == pytest.approx(math.sqrt(variance / windows), rel=0.1)


@pytest.mark.parametrize("flight", [{"bank": 20.0}, {"bank": 0.0, "gust": 0.0}], ids=str)
def test_an_imu_that_points_backwards_is_named_before_any_row_is_usable(
    flight: dict[str, Any],
) -> None:
    """Gravity does not show it: roll and pitch rate are reversed, and so are ax and ay."""
    measured = light_measured(30.0, **flight)
    right, reversed_ = (identified(measured, imu__rpy=(0.0, 0.0, yaw)) for yaw in (0.0, math.pi))
    assert not right[0].plausibility.noted
    assert not any(True in e.usable_rows for e in reversed_[1])
    text = reversed_[0].plausibility.noted["backwards"].text
    assert "points backwards: its turns fit -" in text
    assert "add 3.14 to the yaw of imu.rpy" in text


@pytest.mark.parametrize("axis", range(3))
def test_a_gyro_axis_of_the_wrong_sign_is_named_in_turns(axis: int) -> None:
    measured = light_measured(20.0, bank=20.0)
    rates = measured.rates.copy()
    rates[:, axis] *= -1.0
    identifier, estimates = identified(replace(measured, rates=rates))
    assert (
        "an axis of the gyro has the wrong sign" in identifier.plausibility.noted["gyro axes"].text
    )
    assert not any(True in e.usable_rows for e in estimates)


def test_a_reference_airspeed_below_half_of_the_speed_is_named() -> None:
    measured = light_measured(20.0, bank=20.0)  # at 20 m/s

    def noted(reference: float, **given: Any) -> str:
        found = identified(measured, airspeed__reference=reference, **given)[0].plausibility.noted
        return found["airspeed"].text if "airspeed" in found else ""

    assert re.search(r"it is 8 m/s, and its turns fit (19|20|21) \+- 1 m/s", noted(8.0))
    assert not noted(11.0)
    assert not noted(8.0, airspeed__type="std_msgs/msg/Float64")
