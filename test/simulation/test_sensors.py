# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest

from uav_ident_ros.simulation.channels import CHANNEL_SETS
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.plant import PlantFlight, vehicle

NOISY = Sensors(rate=1000.0, gyro_noise=0.02, accelerometer_noise=0.1)


@pytest.fixture(scope="module")
def flight() -> Flight:
    segment = Segment("multisine", amplitudes={"de": 0.1, "dr": 0.1, "da": 0.1, "dth": 0.2})
    spec = PlantFlight((segment,), 20.0, vehicle=vehicle("small_uav"), force=ColouredNoise(0.5))
    return spec.fly()


def test_noise_and_bias_have_the_configured_size(flight: Flight) -> None:
    bias = (0.1, -0.2, 0.05)
    measured = measure(flight, dataclasses.replace(NOISY, gyro_bias=bias, convention="frd"), seed=3)
    error = measured.rates - measured.true_rates
    np.testing.assert_allclose(error.mean(axis=0), bias, atol=5e-4)
    np.testing.assert_allclose(error.std(axis=0), 0.02, rtol=0.03)
    white = error - error.mean(axis=0)
    correlation = (white[1:] * white[:-1]).mean(axis=0) / white.var(axis=0)
    assert np.abs(correlation).max() < 0.03
    force = measured.specific_force - flight.specific_force
    np.testing.assert_allclose(force.std(axis=0), 0.1, rtol=0.03)


def test_the_airspeed_is_measured_at_its_own_rate_where_there_is_a_sensor(flight: Flight) -> None:
    fast = dataclasses.replace(flight, airspeed=20.0 + flight.rates[:, 0])
    pitot = dataclasses.replace(NOISY, airspeed_noise=0.3, airspeed_bias=0.5)
    measured, blind = measure(fast, pitot), measure(fast, NOISY)
    assert measured.airspeed_t_ns.tolist() == fast.t_ns[::100].tolist()
    error = measured.airspeed - fast.airspeed[::100]
    assert error.mean() == pytest.approx(0.5, abs=0.07) and error.std() == pytest.approx(
        0.3, rel=0.2
    )
    assert (
        len(blind.airspeed)
        == len(blind.airspeed_log_ns)
        == len(measure(flight, pitot).airspeed)
        == 0
    )
    np.testing.assert_array_equal(measured.rates, blind.rates)


def test_flu_and_frd_are_the_same_flight(flight: Flight) -> None:
    flu, frd = (measure(flight, dataclasses.replace(NOISY, convention=c)) for c in ("flu", "frd"))
    for name in ("rates", "specific_force"):
        turned = getattr(frd, name) * [1.0, -1.0, -1.0]
        np.testing.assert_array_equal(getattr(flu, name), turned)
    assert flu.specific_force[:, 2].mean() == pytest.approx(9.8, abs=0.1)  # up, in level flight
    assert (flu.frame_id, frd.frame_id) == ("base_link", "base_link_frd")


def test_jitter_moves_stamps_and_nothing_else(flight: Flight) -> None:
    plain = measure(flight, NOISY)
    shaky = measure(flight, dataclasses.replace(NOISY, stamp_jitter=0.005))
    np.testing.assert_array_equal(shaky.rates, plain.rates)
    error = (shaky.imu_t_ns - shaky.true_t_ns) * 1e-9
    assert 0.0045 < np.abs(error).max() <= 0.005
    assert abs(error.mean()) < 2e-4


def test_latency_delays_the_log_in_order(flight: Flight) -> None:
    measured = measure(flight, dataclasses.replace(NOISY, latency=0.004))
    wait = (measured.imu_log_ns - measured.true_t_ns) * 1e-9
    assert wait.min() >= 0.002
    # the order of arrival is kept, which holds back what follows a straggler
    assert 0.004 <= wait.mean() < 0.02
    assert np.all(np.diff(measured.imu_log_ns) >= 0)


def test_signs_of_the_channel_sets() -> None:
    trim = np.array([0.0, 0.0, 0.0, 0.5])
    roll_right = np.array([[0.0, 0.0, 0.1, 0.0]])
    left, right, *_ = CHANNEL_SETS["elevon"].raw(roll_right, trim)[0]
    assert left > 0.0 > right  # left trailing edge down lifts the left wing
    motors = CHANNEL_SETS["quadrotor"]
    thrust = dict(zip(motors.names, motors.raw(roll_right, trim)[0], strict=True))
    assert thrust["motor_front_left"] > 0.5 > thrust["motor_front_right"]
    nose_down = motors.raw(np.array([[0.1, 0.0, 0.0, 0.0]]), trim)[0]
    thrust = dict(zip(motors.names, nose_down, strict=True))
    assert thrust["motor_rear_left"] > 0.5 > thrust["motor_front_left"]
    assert CHANNEL_SETS["pwm"].raw(np.zeros((1, 4)), trim)[0].tolist() == [1500, 1500, 1500, 1500]
