# SPDX-License-Identifier: Apache-2.0
"""Speed scaling: one set of coefficients over a range of airspeeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from changing_speed import (
    PLANT,
    REFERENCE,
    START_NS,
    STRUCTURE,
    airspeed,
    flight,
    scaled,
    worst_linear,
)

from uav_ident_ros.identification.drops import Drop
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import AIRSPEED, OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray


@pytest.fixture(scope="module")
def flown() -> tuple[FloatArray, FloatArray, FloatArray]:
    return flight(60.0)


def identify(
    flown: tuple[FloatArray, FloatArray, FloatArray], **values: Any
) -> tuple[OnlineIdentifier, Estimate]:
    identifier = OnlineIdentifier(
        Settings.from_values(
            {"structure": STRUCTURE.name, "imu.convention": "frd", "forgetting_time": 0.0, **values}
        )
    )
    estimate = None
    for t, x, u in zip(*flown, strict=True):
        t_ns = START_NS + round(t * 1e9)
        identifier.add_actuators(t_ns, u.tolist())
        identifier.add_airspeed(t_ns, float(airspeed(t)))
        identifier.add_rates(t_ns, x.tolist())
        while (due := identifier.due()) is not None:
            estimate = identifier.update(due)
    assert estimate is not None
    return identifier, estimate


def test_one_set_of_coefficients_over_all_speeds(
    flown: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    identifier, estimate = identify(
        flown, **{"airspeed.type": "std_msgs/msg/Float64", "airspeed.reference": REFERENCE}
    )
    assert worst_linear(identifier.coefficient_set().values, PLANT.coefficients) < 0.02
    now = (estimate.t_ns - START_NS) * 1e-9
    assert worst_linear(estimate.coefficients, scaled(float(airspeed(np.array(now))))) < 0.02


def test_without_an_airspeed_the_scaling_is_off(
    flown: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    identifier, estimate = identify(flown)
    np.testing.assert_array_equal(identifier.coefficient_set().values, estimate.coefficients)
    assert worst_linear(estimate.coefficients, PLANT.coefficients) > 0.05


def test_it_waits_for_the_first_airspeed(
    flown: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    identifier = OnlineIdentifier(
        Settings.from_values({"structure": STRUCTURE.name, "airspeed.type": "std_msgs/msg/Float64"})
    )
    estimate = None
    for t, x, u in list(zip(*flown, strict=True))[:600]:
        t_ns = START_NS + round(t * 1e9)
        identifier.add_actuators(t_ns, u.tolist())
        identifier.add_rates(t_ns, x.tolist())
        while (due := identifier.due()) is not None:
            estimate = identifier.update(due)
    assert estimate is not None
    assert (estimate.state, estimate.reason) == ("waiting", "waiting for airspeed")
    assert not estimate.coefficients.any()


def test_bad_airspeeds_are_dropped_and_counted() -> None:
    identifier = OnlineIdentifier(Settings.from_values({"airspeed.type": "std_msgs/msg/Float64"}))
    identifier.add_rates(START_NS, (0.0, 0.0, 0.0))
    assert identifier.add_airspeed(START_NS, float("nan")) is Drop.NOT_FINITE
    assert identifier.add_airspeed(0, 20.0) is Drop.ZERO_STAMP
    assert identifier.add_airspeed(START_NS + 10**10, 20.0) is Drop.CLOCK_MISMATCH
    assert identifier.drops[AIRSPEED].total() == 3
