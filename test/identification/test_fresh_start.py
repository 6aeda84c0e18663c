# SPDX-License-Identifier: Apache-2.0
"""A flight after carrying the aircraft with moving surfaces: learning begins anew in the air."""

from dataclasses import replace
from typing import Any

import flying
import numpy as np
import pytest
from light_aircraft import TRUTH
from verdict_flights import SENSORS, SHORT, Series, carried

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.estimators import Estimator, make_estimator
from uav_ident_ros.identification.estimators.model_error import known_inputs
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Measurements

CARRIED = 20.0
"""Time of carrying before the launch, s."""

FLIGHT = STRUCTURES["flight_dynamics"]


def test_after_a_launch_the_coefficients_are_usable_and_accurate() -> None:
    launched = carried(CARRIED, 1, flying.light_measured(110.0, seed=6))
    end_ns = launched.imu_t_ns[0] + 100e9
    stream = [m for m in flying.messages(launched) if m.t_ns < end_ns]
    identifier, estimates = flying.identified(launched, stream=stream)
    assert not any(any(e.usable_rows) for e in flying.since(estimates, 0.0, CARRIED))
    last, place = estimates[-1], FLIGHT.index("pdot/da")
    assert np.mean([e.usable for e in flying.since(estimates, 80.0, 100.0)]) > 0.9
    assert abs(last.coefficients[place] - TRUTH["pdot/da"]) < 3.0 * last.sigma[place]
    assert last.sigma[place] < 0.1 * TRUTH["pdot/da"]
    assert identifier.supervisor.changed == []  # no change is reported


def learned(flown: Measurements) -> tuple[list[Estimate], bool]:
    """Return the estimates of a flight, and whether its learning began anew."""
    identifier = OnlineIdentifier(flying.settings(flown))
    first = identifier.estimator
    estimates = flying.run(identifier, flying.messages(flown))
    return estimates, identifier.estimator is not first


def test_known_coefficients_are_never_learned_anew() -> None:
    assert not learned(flying.light_measured(45.0))[1]


BIAS = (0.05, -0.05, 0.035)
"""Gyro bias, rad/s: the light aircraft's filters find it after 24 s."""


def test_after_a_gyro_bias_is_found_the_effects_of_the_flow_angles_are_learned_anew() -> None:
    """The attitude was off by a radian: `pdot/beta` is 35 % off at first, with a sigma of 11 %."""
    flown = flying.light_measured(75.0, bank=20.0, sensors={"gyro_bias": BIAS})
    estimates, anew = learned(flown)
    assert anew
    assert np.mean([e.usable for e in flying.since(estimates, 30.0, 75.0)]) > 0.9
    last = estimates[-1]
    for name in ("pdot/beta", "rdot/beta", "rdot/r"):
        place = FLIGHT.index(name)
        assert last.coefficients[place] == pytest.approx(TRUTH[name], rel=0.12), name


def test_after_a_gyro_bias_is_found_the_delay_is_judged_anew() -> None:
    """Predictions with the wrong attitude made the inputs look 18 ms late."""
    sensors = replace(SENSORS, gyro_bias=(0.2, -0.2, 0.14))
    trial = Series("", 1, SHORT).trial("light_aircraft", "", bank=20.0, wind=0.3, sensors=sensors)
    flown = trial.fly()
    assert isinstance(flown, Measurements)
    estimates, _ = learned(flown)
    assert np.mean([e.usable for e in flying.since(estimates, 40.0, 80.0)]) > 0.9


def test_after_a_gyro_bias_is_found_what_is_known_stays_until_it_is_known_again() -> None:
    excited = Segment("multisine", 2.0, 20.0, flying.PEAKS, seed=1)
    flown = flying.light_measured(70.0, bank=20.0, segments=(excited,), sensors={"gyro_bias": BIAS})
    assert not learned(flown)[1]


def test_a_lateness_that_may_be_noise_is_no_reason_to_begin_anew() -> None:
    """A rudder of 22 +- 21, perhaps 96 % late, is not known."""
    identifier, first = flying.begun("proto_flt09", 130.0)
    assert identifier.estimator is first


def test_a_custom_estimator_shared_by_both_estimates_learns_once() -> None:
    flown = flying.light_measured(10.0)
    usual = flying.identified(flown)[1][-1]
    own: list[Estimator] = []

    def make(settings: Any, start: Any) -> Estimator:
        own.append(own[0] if own else make_estimator(settings, start))
        return own[-1]

    identifier = OnlineIdentifier(flying.settings(flown), estimator=make)
    once = flying.run(identifier, flying.messages(flown))[-1]
    np.testing.assert_array_equal(once.coefficients, usual.coefficients)


@pytest.mark.parametrize(
    ("t_ratio", "model_error", "known"), [(3.5, 0.0, True), (3.5, 1.0, True), (2.5, 0.0, False)]
)
def test_model_errors_make_no_input_unknown(
    t_ratio: float, model_error: float, known: bool
) -> None:
    """An unmodelled servo lag is a model error and no reason to begin anew."""
    coefficients, sigma = np.zeros(FLIGHT.mask.shape), np.ones(FLIGHT.mask.shape)
    at = FLIGHT.index("rdot/dr")
    coefficients[at], sigma[at] = t_ratio, np.hypot(1.0, model_error * t_ratio)
    found = known_inputs(coefficients, sigma, np.full(3, model_error))
    assert found.tolist() == [False, False, known]
