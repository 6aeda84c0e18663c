# SPDX-License-Identifier: Apache-2.0
"""Gyro: turns and specific force show its bias, and wrong axes whatever the bias."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from flying import TICK, by_ticks, identified, light_measured
from verdict_flights import fly

from uav_ident_ros.identification.gyro import HYPOTHESES, GyroFilters
from uav_ident_ros.identification.lift import LiftSigns
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.scales import DOUBTLESS, RESPONSE_TIME, SURE
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.noise import Measurements

BLOCK = round(RESPONSE_TIME / TICK)
NONE, BACKWARDS, X_OR_Z, Y = (hypothesis.problem for hypothesis in HYPOTHESES)
Z = "axis z of the gyro has the wrong sign, by itself or with axis x"


@cache
def flown() -> tuple[FloatArray, FloatArray]:
    """Return rates and specific forces of an excited flight with turns and gusts, by ticks."""
    return by_ticks(light_measured(100.0, bank=30.0, gust=2.0, sensors={"convention": "frd"}))


def evidence(rates: FloatArray, force: FloatArray, airspeed: float = 20.0) -> GyroFilters:
    """Return the filters after all blocks of the signals."""
    filters, steps = GyroFilters(), np.full(BLOCK, TICK)
    for first in range(0, len(rates), BLOCK):
        filters.add(steps, rates[first : first + BLOCK], force[first : first + BLOCK], airspeed)
    return filters


def found(
    rates: FloatArray, force: FloatArray, airspeed: float = 20.0, sure: float = DOUBTLESS
) -> str:
    """Return what is wrong with the axes."""
    axes = evidence(rates, force, airspeed).wrong_axes(sure)
    return axes[0].problem if axes else NONE


@pytest.mark.parametrize("bias", [0.0, 0.2], ids="bias {}".format)
@pytest.mark.parametrize(
    ("gyro", "accelerometer", "expected"),
    [
        ((1, 1, 1), (1, 1, 1), NONE),
        ((-1, -1, 1), (-1, -1, 1), BACKWARDS),
        ((1, -1, -1), (1, 1, 1), BACKWARDS),  # the other convention: backwards in a mirror
        ((-1, -1, 1), (1, 1, 1), BACKWARDS),
        ((-1, 1, 1), (1, 1, 1), X_OR_Z),
        ((1, 1, -1), (1, 1, 1), X_OR_Z),
        ((1, -1, 1), (1, 1, 1), Y),
        ((-1, -1, -1), (1, 1, 1), Y),
        ((-1, 1, -1), (1, 1, 1), Z),  # the mirror image for gravity, not for the side force
    ],
)
def test_turns_show_wrong_signs_beside_a_bias(
    gyro: tuple[int, int, int], accelerometer: tuple[int, int, int], expected: str, bias: float
) -> None:
    rates, force = flown()
    biased = gyro * rates + bias * np.array([1.0, -1.0, 0.7])
    assert found(biased, accelerometer * force) == expected


def test_a_bias_beyond_all_measure_does_not_blame_the_axes() -> None:
    """The filter is not linear there, and fits better with a reversed pitch; the lift objects."""
    measured = light_measured(100.0, bank=25.0, sensors={"convention": "frd"})
    rates, force = by_ticks(measured)
    assert found(rates + 0.45, force, sure=SURE) == NONE


def test_the_bias_of_the_gyro_is_found_in_a_minute_and_kept_in_a_new_stretch() -> None:
    """The attitude is not kept: what accelerates the aircraft looks like a pitch of 11 degrees."""
    bias = np.array([0.1, -0.2, 0.1])
    rates, force = (signal[: round(60.0 / TICK)] for signal in flown())
    assert not evidence(rates, force).bias.any()
    filters = evidence(rates + bias, force)
    before = filters.bias.copy()
    assert before == pytest.approx(bias, abs=0.02)
    filters.restart()
    for forward in (0.0, 2.0, 2.0):  # m/s^2
        ahead = np.tile([forward, 0.0, -GRAVITY], (BLOCK, 1))
        filters.add(np.full(BLOCK, TICK), np.tile(bias, (BLOCK, 1)), ahead, 20.0)
    assert filters.bias == pytest.approx(before, abs=0.01)


@pytest.mark.parametrize(
    ("airspeed", "side_force", "omega", "phase"),
    [(110.0, -50.0, 1.5, 90.0), (55.0, -15.0, 1.8, 45.0), (55.0, -15.0, 1.8, 90.0)],
)
def test_a_dutch_roll_blames_neither_the_axes_nor_the_bias(
    airspeed: float, side_force: float, omega: float, phase: float
) -> None:
    """Sideslip of 6 deg, bank of 20 deg, ahead of it by the phase: the path does not follow."""
    t = np.arange(round(90.0 / TICK)) * TICK
    slip, roll = 0.1 * np.sin(omega * t), 0.35 * np.sin(omega * t + math.radians(phase))
    force = side_force * slip
    turn = (force + GRAVITY * np.sin(roll)) / (airspeed * np.cos(roll))  # of the path, rad/s
    p, yaw = 0.35 * omega * np.cos(omega * t + math.radians(phase)), turn - np.gradient(slip, t)
    rates = np.stack([p, yaw * np.sin(roll), yaw * np.cos(roll)], axis=1)
    up = -GRAVITY * np.cos(roll) - airspeed * turn * np.sin(roll)
    filters = evidence(rates, np.stack([np.zeros_like(t), force, up], axis=1), airspeed)
    assert filters.wrong_axes(SURE) is None
    assert not filters.bias.any()


@pytest.mark.parametrize("airspeed", [15.0, 50.0])
def test_a_biased_gyro_at_rest_shows_no_wrong_axes(airspeed: float) -> None:
    """On a tail wheel, for five minutes, with the drift of a cheap gyro."""
    rng, count = np.random.default_rng(1), round(300.0 / TICK)
    bias = np.array([0.05, -0.05, 0.05]) + np.cumsum(rng.normal(0.0, 1e-4, (count, 3)), axis=0)
    force = GRAVITY * np.array([math.sin(0.25), 0.0, -math.cos(0.25)])
    noise = rng.normal(0.0, 0.1, (count, 3))
    assert found(bias + rng.normal(0.0, 0.01, (count, 3)), force + noise, airspeed, SURE) == NONE


def whole(*flight: Any) -> Measurements:
    """Measurements of a JSBSim aircraft in level flight, or of the light one in turns."""
    if isinstance(flight[0], str):
        pytest.importorskip("jsbsim", reason="JSBSim is a development extra")
        return fly(flight[0], 1, duration=40.0)
    bank, gust = flight
    return light_measured(36.0, bank=bank, gust=gust)


@pytest.mark.parametrize(
    "flight", [(20.0, 0.3), (30.0, 2.0), *zip(("T37", "ultra_stick_25e", "A4"))], ids=str
)
def test_an_imu_that_points_backwards_is_named_and_never_usable(flight: tuple[Any, ...]) -> None:
    """Gravity does not show it: roll and pitch rate are reversed, and so are ax and ay."""
    (right, estimates), (backwards, named) = (
        identified(whole(*flight), imu__rpy=(0.0, 0.0, yaw)) for yaw in (0.0, math.pi)
    )
    assert not right.plausibility.noted and right.plausibility.doubt is None
    level, rows = isinstance(flight[0], str), [e.usable_rows for e in estimates]
    assert all(rows[-1]) if level else any(True in usable for usable in rows)
    assert not any(True in e.usable_rows for e in named)
    text = backwards.plausibility.noted["axes"].text
    assert text.startswith("the Imu points backwards, or")
    assert "Add 3.14 to the yaw of imu.rpy" in text


def test_a_gyro_axis_of_the_wrong_sign_is_named_and_never_usable() -> None:
    measured = whole(20.0, 0.3)
    reversed_ = replace(measured, rates=measured.rates * [-1.0, 1.0, 1.0])
    identifier, estimates = identified(reversed_)
    assert "axis x or axis z of the gyro" in identifier.plausibility.noted["axes"].text
    assert not any(True in e.usable_rows for e in estimates)


@pytest.mark.parametrize(
    "read",
    [
        *({"airspeed__reference": wrong} for wrong in (7.0, 60.0, 200.0)),
        {"structure": "augmented", "imu__rpy": (0.0, 0.0, math.pi)},
    ],
    ids=str,
)
def test_a_wrong_airspeed_or_rotors_flown_backwards_blame_no_axis(read: dict[str, Any]) -> None:
    """The true one is 20 m/s. At ten times of it the filters lose the attitude."""
    assert not identified(light_measured(40.0, bank=20.0), **read)[0].plausibility.noted


@pytest.mark.parametrize("arm", [-0.3, 0.3])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_correction_of_a_lever_arm_is_no_evidence_of_lift(arm: float, seed: int) -> None:
    """In calm air alone gyro noise is in both: in the velocity, and in the corrected force."""
    rng = np.random.default_rng(seed)
    count, step, weight = 60 * 100, 0.01, np.array([0.0, 0.0, GRAVITY])
    edges = rng.normal(scale=0.01, size=(count + 1, 3))
    rates, turning = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges, axis=0) / step
    force = rng.normal(scale=0.05, size=(count, 3)) - weight
    force[:, 1:] -= arm * turning[:, :0:-1] * (1.0, -1.0)
    largest = []
    for corrected in (False, True):
        lift = LiftSigns()
        gravity = np.tile(weight, (count, 1))
        lift.add(np.full(count, step), rates, force, gravity, 20.0, corrected=corrected)
        largest.append(abs(lift.sigmas).max())
    assert largest[0] > DOUBTLESS
    assert largest[1] < SURE


# --- on the ground ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("airspeed", "told"),
    [(1.0, {}), (20.0, {"armed__type": "std_msgs/msg/Bool"})],
    ids=["slow", "not armed"],
)
def test_an_aircraft_known_to_be_on_the_ground_gets_no_verdict_on_its_axes(
    airspeed: float, told: dict[str, str]
) -> None:
    """A hand turns it, the Imu 0.2 m ahead; the flight afterwards is not suspected for that."""
    m = light_measured(60.0, sensors={"convention": "frd", "airspeed_noise": 0.1})
    step = 1.0 / m.sensors.rate
    swing = (
        np.array([[3.0, 5.1], [2.3, 4.4], [1.7, 3.8]])[..., None] * step * np.arange(len(m.rates))
    )
    size = [[0.15, 0.08], [0.12, 0.1], [0.15, 0.1]]
    roll, pitch, yaw = np.einsum("as,ask->ak", size, np.sin(swing))
    turning = np.gradient(np.stack([roll, pitch, yaw]), step, axis=1)
    (cr, sr), (cp, sp) = ((np.cos(angle), np.sin(angle)) for angle in (roll, pitch))
    p = turning[0] - sp * turning[2]
    q, r = cr * turning[1] + sr * cp * turning[2], cr * cp * turning[2] - sr * turning[1]
    rates, arm = np.stack([p, q, r], axis=1), np.array([0.2, 0.0, 0.0])
    force = np.cross(np.gradient(rates, step, axis=0), arm) + np.cross(rates, np.cross(rates, arm))
    force -= GRAVITY * np.stack([-sp, sr * cp, cr * cp], axis=1)
    speed = np.full(len(m.airspeed), airspeed)
    identifier, _ = identified(
        replace(m, rates=rates, specific_force=force, airspeed=speed), **told
    )
    assert "axes" not in identifier.plausibility.noted
