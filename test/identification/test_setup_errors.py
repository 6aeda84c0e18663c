# SPDX-License-Identifier: Apache-2.0
"""What an accelerometer does to the derivatives that is not where the settings say."""

from functools import cache

import numpy as np
import pytest
from flying import flight_of, messages, run, settings
from light_aircraft import LightFlight

from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.plausibility import SetupErrors
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure

AILERON = 45.0
"""pdot/da of the aircraft, 1/s^2."""


@cache
def flown(height: float, told: float) -> tuple[OnlineIdentifier, Estimate]:
    """Return an identifier after an excited flight with the Imu above the centre of gravity, m."""
    peaks = {"de": 0.06, "dr": 0.08, "da": 0.06, "dth": 0.1}
    segments = [Segment("multisine", 2.0, 40.0, peaks, seed=1)]
    sensors = Sensors(
        rate=100.0, gyro_noise=0.01, accelerometer_noise=0.15, lever_arm=(0.0, 0.0, -height)
    )
    m = measure(flight_of(LightFlight(segments, 40.0, gust=0.3, seed=1)), sensors)
    identifier = OnlineIdentifier(settings(m, imu__lever_arm=[0.0, 0.0, -told]))
    return identifier, run(identifier, messages(m))[-1]


@pytest.mark.parametrize("height", [0.1, -0.1])
def test_the_height_of_the_imu_is_found_and_sigma_covers_what_it_does(height: float) -> None:
    identifier, last = flown(height, 0.0)
    index = identifier.structure.index("pdot/da")
    value, sigma = last.coefficients[index], last.sigma[index]
    assert identifier.estimator.height == pytest.approx(height, abs=0.02)
    assert sigma > 1.5 * identifier.estimator.sigma[index]
    assert 0.15 * AILERON < abs(value - AILERON) < 2.0 * sigma


def test_sigma_covers_what_a_lag_takes_from_an_input_where_nothing_damps() -> None:
    structure = STRUCTURES["flight_dynamics"]
    values, rudder = np.zeros((5, structure.size)), structure.index("rdot/dr")
    values[rudder] = -9.0
    sure = DelayEstimate(delay=0.1, sigma=0.01, rise=9.0, hidden=0.1)
    lost, setup = np.array([0.0, 0.3, 0.0, 0.0]), SetupErrors(structure, 20.0)
    setup.look(values, sure, 0.1, lambda: lost, 0.0, lag_is_told=False)
    assert setup.widened(np.full(values.shape, 0.1))[rudder] == pytest.approx(2.7, rel=0.01)
    assert "servo lag are not separated" in setup.denied(values, 4.0)[2]
    setup.look(values, sure, 0.1, lambda: lost, 0.0, lag_is_told=True)
    assert setup.widened(np.full(values.shape, 0.1))[rudder] == 0.1


def test_a_height_that_is_told_is_none_that_is_off() -> None:
    identifier, last = flown(0.3, 0.3)
    assert identifier.estimator.height == 0.0
    assert last.usable, last.reason


def test_no_roll_that_a_height_falsifies_by_a_quarter_is_usable() -> None:
    _, last = flown(-0.3, 0.0)
    assert not last.usable_rows[0]
    assert "m below where 'imu.lever_arm' puts it" in last.reason
