# SPDX-License-Identifier: Apache-2.0
"""What is known before a flight: each prior beside what real aircraft have."""

import numpy as np
import pytest

from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.prior import first_values, resumed, slope_bounds, weak_sigma
from uav_ident_ros.identification.structure import STRUCTURES

FLIGHT = STRUCTURES["flight_dynamics"]

LIVELIEST = {"pdot/p": (2, 16.1), "qdot/alpha": (3, 102.5), "pdot/da": (6, 159.0)}
"""Largest derivatives of ultra_stick_25e, a model of 1.3 m; how many times as wide the prior is."""


def sigma(name: str, structure: str = "flight_dynamics") -> float:
    own = STRUCTURES[structure]
    return float(weak_sigma(own)[own.index(name)])


@pytest.mark.parametrize("name", LIVELIEST)
def test_the_prior_is_wide_enough_for_a_small_model(name: str) -> None:
    times, value = LIVELIEST[name]
    assert sigma(name) == pytest.approx(times * value, rel=0.2)


def test_a_moment_goes_with_a_force_as_far_as_lift_is_weight() -> None:
    assert sigma("qdot/az", "augmented") == pytest.approx(sigma("qdot/de") / 98.0, rel=0.2)


def test_lift_is_weight_and_side_force_a_sixth_of_it() -> None:
    """With a lift slope of 5 and a lift coefficient of 0.5."""
    slopes = first_values(FLIGHT)
    lift = slopes[FLIGHT.index("az/alpha")]
    assert lift == pytest.approx(-GRAVITY * 5.0 / 0.5, rel=0.2)
    assert slopes[FLIGHT.index("ay/beta")] == pytest.approx(lift / 6.0, rel=0.2)
    assert sigma("az/alpha") == -lift
    bounds = slope_bounds(FLIGHT)
    assert bounds[FLIGHT.index("az/alpha")] == pytest.approx(0.1 * lift)


def test_a_rudder_turns_most_of_what_makes_side_force_an_elevator_little_of_the_lift() -> None:
    side, lift = sigma("ay/beta"), sigma("az/alpha")
    assert sigma("ay/dr") == pytest.approx(0.9 * 2.0 / 3.0 * side, rel=0.2)
    assert 1.2 < sigma("az/de") / (0.5 * 0.2 * lift) < 2.0


def test_a_rate_of_turn_changes_the_sideslip_of_the_fin() -> None:
    """By its arm, 1.5 m, over the airspeed, 15 m/s."""
    for name in ("ay/p", "ay/r"):
        assert sigma(name) == pytest.approx(1.5 / 15.0 * sigma("ay/beta"), rel=0.2)


def test_kinematics_miss_a_bias_of_the_accelerometer_and_the_wings_angle() -> None:
    for name in ("betadot/1", "alphadot/1"):
        assert sigma(name) == pytest.approx(0.1 * GRAVITY / 5.0, rel=0.2)
    assert sigma("betadot/p") == pytest.approx(np.deg2rad(12.0), rel=0.2)


def test_what_another_flight_knew_well_is_known_to_a_fifth() -> None:
    values = first_values(FLIGHT)
    saved = CoefficientSet(FLIGHT.name, values, np.where(FLIGHT.mask, 1e-9, 0.0))
    known = values != 0.0
    assert resumed(saved).sigma[known] == pytest.approx(0.2 * np.abs(values[known]), rel=1e-6)
