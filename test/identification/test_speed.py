# SPDX-License-Identifier: Apache-2.0
"""Speed scaling: one set of coefficients over a range of airspeeds."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from flying import AMPLITUDES

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import AirspeedSettings, Settings
from uav_ident_ros.identification.speed import SpeedScaling
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.inputs import Segment, sample_inputs
from uav_ident_ros.simulation.plant import SMALL_UAV

RATE = 100.0
STEPS = 4
"""Integration steps between two samples."""
REFERENCE = 20.0
START_NS = 1_700_000_000 * 10**9
PLANT = SMALL_UAV
STRUCTURE = STRUCTURES[PLANT.structure]


def airspeed(t: FloatArray) -> FloatArray:
    """Slow variation between 14 and 28 m/s."""
    return 21.0 + 7.0 * np.sin(2 * np.pi * t / 40.0)


def scaled(speed: float) -> FloatArray:
    """Coefficients of the plant at an airspeed."""
    ratio = speed / REFERENCE
    power = np.r_[np.zeros(5), np.ones(3), 2.0 * np.ones(4)]
    return PLANT.coefficients * ratio**power


@cache
def flown() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, rates and inputs of a plant whose coefficients follow the airspeed."""
    t = np.arange(round(40.0 * RATE)) / RATE
    u = sample_inputs([Segment("multisine", amplitudes=AMPLITUDES, seed=1)], t)
    x = np.zeros((len(t), 3))
    for k in range(len(t) - 1):
        x[k + 1], h = x[k], 1.0 / RATE / STEPS
        a = scaled(float(airspeed(t[k])))
        for _ in range(STEPS):  # midpoint rule
            middle = x[k + 1] + 0.5 * h * (a @ STRUCTURE.regressor(x[k + 1], u[k]))
            x[k + 1] += h * (a @ STRUCTURE.regressor(middle, u[k]))
    return t, x, u


def worst_linear(found: FloatArray, truth: FloatArray) -> float:
    linear = STRUCTURE.mask & (np.arange(12) >= 5)
    return float(np.abs(found / np.where(linear, truth, 1.0) - 1.0)[linear].max())


FRD = {"imu.convention": "frd", "forgetting_time": 0.0, "update_rate": 10.0}
MEASURED = {"airspeed.type": "std_msgs/msg/Float64", "airspeed.reference": REFERENCE}


def identify(
    silent: tuple[float, float] = (0.0, 0.0), **values: Any
) -> tuple[OnlineIdentifier, list[Estimate]]:
    """The identifier after the flight, and its estimates; no airspeed in an interval, s."""
    plain = {"structure": STRUCTURE.name, **FRD}
    identifier = OnlineIdentifier(Settings.from_values({**plain, **values}))
    estimates: list[Estimate] = []
    for t, x, u in zip(*flown(), strict=True):
        t_ns = START_NS + round(t * 1e9)
        identifier.add_actuators(t_ns, u.tolist())
        if not silent[0] < t < silent[1]:
            identifier.add_airspeed(t_ns, float(airspeed(t)))
        identifier.add_rates(t_ns, x.tolist())
        estimates += identifier.advance()
    return identifier, estimates


def test_one_set_of_coefficients_holds_at_all_airspeeds() -> None:
    identifier, (*_, estimate) = identify(**MEASURED)
    assert worst_linear(identifier.coefficient_set().values, PLANT.coefficients) < 0.02
    now = (estimate.t_ns - START_NS) * 1e-9
    assert worst_linear(estimate.coefficients, scaled(float(airspeed(np.array(now))))) < 0.02


def test_a_silent_airspeed_pauses_learning_and_denies_the_verdict_until_it_returns() -> None:
    _, estimates = identify(silent=(32.0, 36.0), **MEASURED)
    states = {
        (e.state, e.reason, e.usable) for e in estimates if 34.1 < (e.t_ns - START_NS) * 1e-9 < 36.0
    }
    assert states == {("paused", "no airspeed has arrived in the last 2 s", False)}
    before, after = (estimates[round(10.0 * t)] for t in (33.0, 37.0))
    assert before.usable and after.usable


def test_without_an_airspeed_the_scaling_is_off() -> None:
    identifier, (*_, estimate) = identify()
    np.testing.assert_array_equal(identifier.coefficient_set().values, estimate.coefficients)
    assert worst_linear(estimate.coefficients, PLANT.coefficients) > 0.05


@pytest.mark.parametrize(
    ("speed", "ratio"), [(200.0, 3.0), (1.0, 1.0 / 3.0), (0.0, 1.0 / 3.0), (40.0, 2.0)]
)
def test_the_scaling_is_limited_to_three_times_the_reference(speed: float, ratio: float) -> None:
    scaling = SpeedScaling(AirspeedSettings("std_msgs/msg/Float64", REFERENCE), STRUCTURE)
    scaling.airspeed.append(START_NS, (speed,))
    scaling.airspeed.merge(START_NS)
    scaling.update(START_NS)
    assert scaling.newest == speed
    assert scaling.scale[STRUCTURE.index("pdot/p")] == pytest.approx(ratio)
    assert scaling.scale[STRUCTURE.index("pdot/da")] == pytest.approx(ratio**2)
