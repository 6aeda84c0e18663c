# SPDX-License-Identifier: Apache-2.0
"""Measurements of a flight by the sensors, and their bags."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from excerpts import decoded
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosReliability

from uav_ident_ros.bags.writing import TWIST, BagWriteError, BagWriter
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.simulation import recording
from uav_ident_ros.simulation.channels import CHANNEL_SETS
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure
from uav_ident_ros.simulation.plant import PlantFlight
from uav_ident_ros.simulation.recording import parameters, write_bag

EXCITED = Segment("multisine", amplitudes={"de": 0.1, "dr": 0.1, "da": 0.1, "dth": 0.2})
FLIGHT = PlantFlight((EXCITED,), 2.0, seed=5)
FRAMES = {"flu": "base_link", "frd": "base_link_frd"}


def recorded(folder: Path, **changes: object) -> tuple[Path, Measurements]:
    measured = measure(FLIGHT.fly("short"), Sensors(gyro_noise=0.02, latency=0.003, **changes), 5)
    write_bag(measured, folder, compress=True)
    return folder, measured


@pytest.mark.parametrize("convention", FRAMES)
def test_rosbags_reads_the_measured_samples_from_the_bag(tmp_path: Path, convention: str) -> None:
    path, measured = recorded(tmp_path / "bag", convention=convention)
    with AnyReader([path]) as reader:
        rows = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    imu = [(t, m) for topic, t, m in rows if topic == "/imu/data"]
    assert [t for t, _ in imu] == measured.imu_log_ns.tolist()
    assert [header_ns(m) for _, m in imu] == measured.imu_t_ns.tolist()
    assert {m.header.frame_id for _, m in imu} == {FRAMES[convention]}
    rates = [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for _, m in imu]
    np.testing.assert_array_equal(rates, measured.rates)
    force = [[getattr(m.linear_acceleration, k) for k in "xyz"] for _, m in imu]
    np.testing.assert_array_equal(force, measured.specific_force)
    assert imu[0][1].orientation_covariance[0] == -1.0  # there is no orientation
    np.testing.assert_allclose(imu[0][1].angular_velocity_covariance[[0, 4, 8]], 0.02**2)
    actuators = [(t, m) for topic, t, m in rows if topic == "/actuators"]
    assert [header_ns(m) for _, m in actuators] == measured.actuator_t_ns.tolist()
    assert list(actuators[0][1].name) == ["elevator", "rudder", "aileron", "throttle"]
    np.testing.assert_array_equal([m.position for _, m in actuators], measured.actuators)
    assert offered["/imu/data"].reliability is QosReliability.BEST_EFFORT
    assert offered["/imu/data"].depth == 500
    assert offered["/actuators"].reliability is QosReliability.RELIABLE


def test_a_measured_airspeed_is_recorded_and_enabled_in_the_parameters(tmp_path: Path) -> None:
    flight = FLIGHT.fly("fast")
    flight = replace(flight, airspeed=np.full(len(flight.t_ns), 20.0))
    measured = measure(flight, Sensors(airspeed_noise=0.3, latency=0.003), 5)
    write_bag(measured, tmp_path / "bag")
    settings = Settings.from_values(parameters(measured))
    assert settings.airspeed.type == TWIST and settings.airspeed.reference == 20.0
    rows = decoded(tmp_path / "bag")["/airspeed"]
    assert {m.__msgtype__ for _, m in rows} == {TWIST}
    assert [t for t, _ in rows] == measured.airspeed_log_ns.tolist()
    assert [header_ns(m) for _, m in rows] == measured.airspeed_t_ns.tolist()
    assert [m.twist.linear.x for _, m in rows] == measured.airspeed.tolist()


def test_the_same_flight_gives_the_same_bytes(tmp_path: Path) -> None:
    first, _ = recorded(tmp_path / "one" / "bag")
    second, _ = recorded(tmp_path / "two" / "bag")
    names = sorted(p.name for p in first.iterdir())
    assert names == ["bag.mcap", "identifier.yaml", "metadata.yaml", "truth.yaml"]
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes()


@pytest.mark.parametrize("channels", ["plain", "elevon", "quadrotor", "pwm"])
@pytest.mark.parametrize("stamped", [True, False])
def test_the_parameters_beside_the_bag_map_channels_to_inputs(
    tmp_path: Path, channels: str, stamped: bool
) -> None:
    flight, path = replace(FLIGHT.fly(), channel_set=CHANNEL_SETS[channels]), tmp_path / "bag"
    measured = measure(flight, Sensors(stamped=stamped))
    write_bag(measured, path)
    content = yaml.safe_load((path / "identifier.yaml").read_text())["/**"]["ros__parameters"]
    settings = Settings.from_values(content)
    mixing = np.array([getattr(settings.actuators.mixing, k) for k in ("de", "dr", "da", "dth")])
    raw = measured.actuators - np.array(settings.actuators.trim)
    np.testing.assert_allclose(raw @ mixing.T, measured.flight.inputs, atol=1e-6)
    assert content.keys() == parameters(measured).keys()


def test_a_failed_write_leaves_no_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: object) -> dict[str, object]:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recording, "truth", full)
    with pytest.raises(BagWriteError, match=r"cannot write .*bag.: No space left on device"):
        recorded(tmp_path / "bag")
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    recorded(tmp_path / "bag")
    with pytest.raises(BagWriteError, match="bag exists already"):
        recorded(tmp_path / "bag")


def test_an_exception_leaves_no_finished_bag(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), BagWriter(tmp_path / "bag") as bag:
        bag.topic("/a", "std_msgs/msg/Float64MultiArray")
        raise RuntimeError
    assert not (tmp_path / "bag" / "metadata.yaml").exists()


NOISY = Sensors(rate=1000.0, gyro_noise=0.02, accelerometer_noise=0.1)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return PlantFlight((EXCITED,), 20.0, force=ColouredNoise(0.5)).fly()


def test_noise_and_bias_have_the_configured_size(flight: Flight) -> None:
    bias = (0.1, -0.2, 0.05)
    measured = measure(flight, replace(NOISY, gyro_bias=bias, convention="frd"), seed=3)
    error = measured.rates - measured.true_rates
    np.testing.assert_allclose(error.mean(axis=0), bias, atol=5e-4)
    np.testing.assert_allclose(error.std(axis=0), 0.02, rtol=0.03)
    white = error - error.mean(axis=0)
    correlation = (white[1:] * white[:-1]).mean(axis=0) / white.var(axis=0)
    assert np.abs(correlation).max() < 0.03
    force = measured.specific_force - flight.specific_force
    np.testing.assert_allclose(force.std(axis=0), 0.1, rtol=0.03)


def test_the_airspeed_has_the_rate_of_its_sensor_and_is_absent_without(flight: Flight) -> None:
    fast = replace(flight, airspeed=20.0 + flight.rates[:, 0])
    pitot = replace(NOISY, airspeed_noise=0.3, airspeed_bias=0.5)
    measured, blind = measure(fast, pitot), measure(fast, NOISY)
    assert measured.airspeed_t_ns.tolist() == fast.t_ns[::100].tolist()
    error = measured.airspeed - fast.airspeed[::100]
    assert error.mean() == pytest.approx(0.5, abs=0.07)
    assert error.std() == pytest.approx(0.3, rel=0.2)
    without = (blind.airspeed, blind.airspeed_log_ns, measure(flight, pitot).airspeed)
    assert not any(map(len, without))
    np.testing.assert_array_equal(measured.rates, blind.rates)


def test_flu_and_frd_are_the_same_flight(flight: Flight) -> None:
    flu, frd = (measure(flight, replace(NOISY, convention=c)) for c in ("flu", "frd"))
    for name in ("rates", "specific_force"):
        turned = getattr(frd, name) * [1.0, -1.0, -1.0]
        np.testing.assert_array_equal(getattr(flu, name), turned)
    assert flu.specific_force[:, 2].mean() == pytest.approx(9.8, abs=0.1)  # up, in level flight


def test_jitter_moves_stamps_and_nothing_else(flight: Flight) -> None:
    plain = measure(flight, NOISY)
    shaky = measure(flight, replace(NOISY, stamp_jitter=0.005))
    np.testing.assert_array_equal(shaky.rates, plain.rates)
    error = (shaky.imu_t_ns - shaky.true_t_ns) * 1e-9
    assert 0.0045 < np.abs(error).max() <= 0.005
    assert abs(error.mean()) < 2e-4


def test_latency_delays_the_log_in_order(flight: Flight) -> None:
    measured = measure(flight, replace(NOISY, latency=0.004))
    wait = (measured.imu_log_ns - measured.true_t_ns) * 1e-9
    assert wait.min() >= 0.002
    # arrival keeps the order: a late message delays the next ones
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
