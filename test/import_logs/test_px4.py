# SPDX-License-Identifier: Apache-2.0
"""Import of PX4 logs of different versions and vehicles."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from excerpts import SECOND_NS, decoded, replay, summary, written
from imported import Imported, Importer, mixing
from pyulog import ULog
from pyulog.ulog2csv import convert_ulog2csv
from ulog_writing import Columns, commands, padded, sensor_combined, stamps, write_ulog

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.commandline import NOT_USABLE
from uav_ident_ros.identification.frames import quaternions, rotation
from uav_ident_ros.simulation.channels import ELEVON, QUADROTOR

SAMPLE = Path(__file__).resolve().parents[3] / "shared" / "logs" / "px4_quad_sample.ulg"

START, STEP = 100_000_000_000, 5_000_000
COUNT = 400
IMU_NS = START + STEP * np.arange(COUNT)
COMMAND_NS = IMU_NS[::4]
RATES = np.random.default_rng(1).normal(size=(COUNT, 3))
FORCE = np.tile([0.1, -0.2, -9.8], (COUNT, 1))

QUAD_X = {
    "CA_AIRFRAME": 0,
    "CA_ROTOR_COUNT": 4,
    # Front right, rear left, front left, rear right.
    **{f"CA_ROTOR{i}_PX": x for i, x in enumerate((0.15, -0.15, 0.15, -0.15))},
    **{f"CA_ROTOR{i}_PY": y for i, y in enumerate((0.25, -0.25, -0.25, 0.25))},
    **{f"CA_ROTOR{i}_KM": k for i, k in enumerate((0.05, 0.05, -0.05, -0.05))},
}


def noise(columns: int) -> np.ndarray:
    return np.random.default_rng(2).uniform(-0.5, 0.5, (len(COMMAND_NS), columns))


def controls(values: np.ndarray, entries: int = 12, late: int = 0, every: int = 1) -> Columns:
    """Return a topic of commands with an array `control`, its unused entries NaN."""
    return commands((COMMAND_NS + late)[::every], padded(values[::every], entries), "control")


def status(t_ns: np.ndarray, field: str, values: list[int]) -> Columns:
    return {"timestamp": stamps(t_ns), field: np.array(values, np.uint8)}


def measured(t_ns: np.ndarray, field: str, values: Any) -> Columns:
    return {"timestamp": stamps(t_ns), field: np.broadcast_to(np.float32(values), len(t_ns))}


COMBINED = sensor_combined(IMU_NS, RATES, FORCE)
TORQUES = {"vehicle_torque_setpoint": commands(COMMAND_NS, noise(3), "xyz")}
MOTORS = {"actuator_motors": controls(0.5 + 0.1 * noise(4))}


def px4(
    importer: Importer,
    topics: dict[Any, Columns],  # By name, or name and instance, beside sensor_combined
    values: dict[str, float] | None = None,
    *options: str,
) -> Imported:
    topics = {"sensor_combined": COMBINED} | topics
    keyed = {key if isinstance(key, tuple) else (key, 0): c for key, c in topics.items() if c}
    return importer(write_ulog(importer.folder / "flight.ulg", keyed, values or {}), *options)


# --- channels -----------------------------------------------------------------------------------


def test_rotors_have_the_mixing_of_the_simulation(importer: Importer) -> None:
    bag, values, printed = px4(importer, MOTORS, QUAD_X)
    assert bag.names == values["actuators.channels"] == ["motor_1", "motor_2", "motor_3", "motor_4"]
    np.testing.assert_allclose(mixing(values), QUADROTOR.mixing, atol=1e-12)
    np.testing.assert_allclose(values["actuators.trim"], np.median(bag.actuators, axis=0))
    assert values["structure"] == "augmented"  # no wings: no angle of attack
    assert "4 rotors" in printed
    assert "da (right wing down) = -0.5 motor_1 +0.5 motor_2 +0.5 motor_3 -0.5 motor_4" in printed


def test_elevons_have_the_mixing_of_the_simulation(importer: Importer) -> None:
    """PX4 counts trailing edge up as positive, the simulation down.

    It publishes motors and servos of one cycle some microseconds apart; the import joins them.
    Flaps are recorded, but not used.
    """
    motors, servos = 0.5 + noise(1), noise(3)
    topics = {
        "actuator_servos": controls(servos, 8, late=30_000),
        "actuator_motors": controls(motors),
    }
    airframe = {
        "CA_AIRFRAME": 1, "CA_ROTOR_COUNT": 1, "CA_SV_CS_COUNT": 3,
        "CA_SV_CS0_TYPE": 5, "CA_SV_CS0_TRQ_R": -0.5, "CA_SV_CS0_TRQ_P": 0.5,
        "CA_SV_CS1_TYPE": 6, "CA_SV_CS1_TRQ_R": 0.5, "CA_SV_CS1_TRQ_P": 0.5,
        "CA_SV_CS1_TRIM": 0.1, "CA_SV_CS2_TYPE": 9, "CA_SV_CS2_TRQ_R": 0.7,
    }  # fmt: skip
    bag, values, _ = px4(importer, topics, airframe, "--trim", "neutral")
    assert bag.names == ["motor_1", "left_elevon", "right_elevon", "left_flap"]
    assert values["actuators.channels"] == bag.names[:3]
    expected = ELEVON.mixing[:, [3, 0, 1]] * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(mixing(values), expected * [[1], [0], [1], [1]], atol=1e-12)
    np.testing.assert_allclose(values["actuators.trim"], [0.0, 0.0, 0.1])
    np.testing.assert_array_equal(bag.actuator_t_ns, COMMAND_NS + 30_000)
    np.testing.assert_array_equal(bag.actuators, np.hstack([motors, servos]).astype(np.float32))
    assert values["supervision.expected_signs"] == ["-qdot/de", "+pdot/da"]  # there is no rudder


def outputs(widths: np.ndarray, count: int) -> Columns:
    t_us = stamps(COMMAND_NS[:: len(COMMAND_NS) // len(widths)])
    values = np.zeros((len(widths), 16), np.float32)
    values[:, :count] = widths
    number = np.full(len(widths), count, np.uint32)
    return {"timestamp": t_us, "noutputs": number, "output": values}


def test_pulse_widths_are_mixed_by_the_functions_of_their_pins(importer: Importer) -> None:
    widths = 1500.0 + 400.0 * noise(3)
    pins = {
        "PWM_MAIN_FUNC1": 201, "PWM_MAIN_MIN1": 1100, "PWM_MAIN_MAX1": 1900,
        "PWM_MAIN_FUNC2": 101, "PWM_MAIN_MIN2": 1000, "PWM_MAIN_MAX2": 1950,
        "PWM_MAIN_FUNC3": 402, "PWM_MAIN_REV": 1,
        "CA_AIRFRAME": 1, "CA_ROTOR_COUNT": 1,
        "CA_SV_CS_COUNT": 1, "CA_SV_CS0_TYPE": 3, "CA_SV_CS0_TRQ_P": 1.0,
    }  # fmt: skip
    topics = {"actuator_outputs": outputs(widths, 3)}
    bag, values, _ = px4(importer, topics, pins, "--trim", "neutral")
    assert bag.names == ["elevator", "motor_1", "output_3"]
    np.testing.assert_array_equal(bag.actuators, widths.astype(np.float32))
    assert values["actuators.channels"] == ["elevator", "motor_1"]
    np.testing.assert_allclose(values["actuators.scale"], [-2.0 / 800.0, 1.0 / 950.0])
    np.testing.assert_allclose(values["actuators.trim"], [1500.0, 1000.0])
    np.testing.assert_allclose(mixing(values), [[-1, 0], [0, 0], [0, 0], [0, 1]])


@pytest.mark.parametrize(
    "ranges",
    [
        {"PWM_MAIN_MIN": 1200, "PWM_MAIN_MAX": 1900, "PWM_MIN": 900},
        {"PWM_MIN": 1200, "PWM_MAX": 1900},
    ],
    ids=["v1.12", "v1.9"],
)
def test_pins_of_old_versions_have_the_common_range_unless_set_individually(
    importer: Importer, ranges: dict[str, int]
) -> None:
    """-1 selects the common range; one of the quadrotor's four motors is reversed."""
    pins = {f"PWM_MAIN_{end}{pin}": -1 for end in ("MIN", "MAX") for pin in range(1, 5)}
    pins |= {"MAV_TYPE": 2, "PWM_MAIN_MIN2": 1100, "PWM_MAIN_REV3": 1}
    topics = {"actuator_outputs": outputs(1500.0 + 300.0 * noise(4), 4)}
    _, values, printed = px4(importer, topics, ranges | pins, "--trim", "neutral")
    np.testing.assert_allclose(1.0 / np.array(values["actuators.scale"]), [700, 800, -700, 700])
    np.testing.assert_allclose(values["actuators.trim"], [1200, 1100, 1900, 1200])
    assert "motor_1: output of quad x, 1200 to 1900 us; us less 1200" in printed


def test_pulse_widths_without_a_known_mixer_are_not_used(importer: Importer) -> None:
    """An old fixed-wing log has them at a slightly higher rate, but lacks the mixer file."""
    topics = {
        "actuator_controls_0": controls(noise(8), 8, every=5),
        "actuator_outputs": outputs(np.full((25, 8), 1500.0), 8),
    }
    bag, values, _ = px4(importer, topics, {"MAV_TYPE": 1})
    np.testing.assert_array_equal(bag.actuators, noise(8)[::5].astype(np.float32))
    assert values["actuators.channels"] == ["roll", "pitch", "yaw", "thrust"]
    np.testing.assert_array_equal(
        mixing(values), [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
    )
    selected = ("--actuators-topic", "actuator_outputs")
    assert "PWM_MAIN_FUNCn" in importer.refused(importer.log, *selected)


@pytest.mark.parametrize(
    ("topics", "parameters", "options", "note"),
    [
        ({("vehicle_torque_setpoint", i): commands(COMMAND_NS, noise(3) + i, "xyz")
          for i in (0, 1)}, {"CA_AIRFRAME": 2}, ["--actuators-instance 1"],
         "of instance 1 those of forward flight (--actuators-instance); 0 is taken"),
        ({f"actuator_controls_{i}": controls(noise(8) + i, 8) for i in (0, 1)}
         | {("actuator_outputs", 1): commands(COMMAND_NS, noise(8), "output")}, {"MAV_TYPE": 22},
         ["--actuators-instance 1", "--actuators-topic actuator_controls_1"],
         "a VTOL: actuator_controls_0 are the commands of hover"),
    ],
    ids=["new", "old"],
)  # fmt: skip
def test_an_option_selects_the_hover_or_forward_flight_commands_of_a_vtol(
    importer: Importer, topics: dict, parameters: dict, options: list[str], note: str
) -> None:
    """They are instances of one topic; before v1.13, two topics."""
    bag, _, printed = px4(importer, topics, parameters)
    values = next(iter(topics.values()))
    first = values.get("xyz", values.get("control"))
    np.testing.assert_array_equal(bag.actuators, first)
    assert note in printed
    for option in options:
        again = importer(importer.log, *option.split()).bag
        np.testing.assert_allclose(again.actuators, first + 1, rtol=1e-6)
    assert "no actuators" in importer.refused(importer.log, "--actuators-instance", "2")


@pytest.mark.parametrize(
    ("force", "note", "names"),
    [((0.1, 0.0, -0.5), "dth is the upward thrust: it is larger", ["thrust_z"]),
     ((0.5, np.nan, np.nan), "dth is the forward thrust: it is larger", ["thrust_x"]),
     ((np.nan,) * 3, "there is no vehicle_thrust_setpoint", [])],
)  # fmt: skip
def test_the_larger_thrust_of_a_vtol_is_its_throttle(
    importer: Importer, force: tuple[float, ...], note: str, names: list[str]
) -> None:
    thrust = commands(COMMAND_NS, np.tile(force, (len(COMMAND_NS), 1)), "xyz")
    topics = TORQUES | {"vehicle_thrust_setpoint": thrust}
    _, values, printed = px4(importer, topics, {"CA_AIRFRAME": 2})
    assert note in printed
    assert values["actuators.channels"][3:] == names


def test_a_topic_that_covers_only_a_part_of_the_flight_is_not_used(importer: Importer) -> None:
    """Both are slow: the faster one was logged in the first fifth only."""
    motors = {name: values[:20:4] for name, values in MOTORS["actuator_motors"].items()}
    topics = {"actuator_motors": motors, "actuator_controls_0": controls(noise(8), 8, every=5)}
    bag, _, printed = px4(importer, topics, QUAD_X)
    assert len(bag.actuators) == len(COMMAND_NS) // 5
    assert "motors covers 43 % of the flight only; actuator_controls_0 is at 10 Hz" in printed
    assert "motors at 12.5 Hz over 43 %, actuator_controls_0 at 10 Hz over 100 %" in printed
    assert "actuator_controls_0 has 10 Hz only: 20 Hz are needed" in printed


# --- rates --------------------------------------------------------------------------------------


def raw_gyro(values: np.ndarray) -> Columns:
    return {
        "timestamp": stamps(IMU_NS) + np.uint64(700),
        "timestamp_sample": stamps(IMU_NS),
        "device_id": np.full(COUNT, 4711, np.uint32),
        **dict(zip("xyz", values.astype(np.float32).T, strict=True)),
    }


def test_a_raw_gyro_is_calibrated_and_rotated_into_body_axes(importer: Importer) -> None:
    """Board on its side (roll 90, yaw 90), with a fine offset, second gyro of two."""
    offset = np.array([0.01, -0.02, 0.03])
    board = rotation(*np.radians([1.5, -1.0, 0.5])) @ rotation(*np.radians([90.0, 0.0, 90.0]))
    in_the_board = RATES @ board + offset  # body to board is the transpose
    gyros = {("sensor_gyro", i): raw_gyro(v) for i, v in enumerate((RATES * 0.0, in_the_board))}
    values = {
        "CA_AIRFRAME": 1, "SENS_BOARD_ROT": 18, "SENS_BOARD_X_OFF": 1.5,
        "SENS_BOARD_Y_OFF": -1.0, "SENS_BOARD_Z_OFF": 0.5, "CAL_GYRO2_ID": 4711,
        "CAL_GYRO2_XOFF": 0.01, "CAL_GYRO2_YOFF": -0.02, "CAL_GYRO2_ZOFF": 0.03,
    }  # fmt: skip
    topics = TORQUES | gyros | {"sensor_combined": {}}
    bag, found, printed = px4(importer, topics, values, "--rates-instance", "1")
    np.testing.assert_allclose(bag.rates, RATES, atol=1e-6)
    np.testing.assert_array_equal(bag.imu_t_ns, IMU_NS)  # when sampled, not when published
    assert "SENS_BOARD_ROT 18, roll 90 deg yaw 90 deg, fine offsets 1.50 -1.00 0.50" in printed
    assert "CAL_GYRO2_XOFF" in printed
    assert "instances [0, 1] of sensor_gyro" in printed
    assert "ay and az are zero" in printed
    assert found["structure"] == "throttle_coupled"


def test_filtered_rates_are_used_only_without_raw_rates_and_noted(importer: Importer) -> None:
    topics = TORQUES | {
        "vehicle_angular_velocity": commands(IMU_NS + 400_000, RATES, "xyz", delay_us=400),
        "vehicle_acceleration": {"timestamp": stamps(IMU_NS), "xyz": FORCE.astype(np.float32)},
    }
    alone = topics | {"sensor_combined": {}}
    bag, _, printed = px4(importer, alone, {"IMU_GYRO_CUTOFF": 40.0})
    assert "low-passed at 40 Hz (IMU_GYRO_CUTOFF)" in printed
    np.testing.assert_array_equal(bag.imu_t_ns, IMU_NS)
    np.testing.assert_array_equal(bag.rates, RATES.astype(np.float32))
    np.testing.assert_allclose(bag.specific_force, FORCE, rtol=1e-6)
    printed = px4(importer, topics).printed
    assert "rates: sensor_combined" in printed
    assert "vehicle_angular_velocity at 200 Hz over 100 %" in printed


@pytest.mark.parametrize(
    ("count", "note"),
    [(COUNT, "no valid accelerometer sample: ay and az are zero"),
     (2, "2 accelerometer samples are invalid: held over")],
)  # fmt: skip
def test_invalid_accelerometer_samples_give_the_last_valid_force(
    importer: Importer, count: int, note: str
) -> None:
    relative = np.zeros(COUNT, np.int32)
    relative[COUNT - count :] = 0x7FFFFFFF
    force = FORCE + np.arange(COUNT)[:, None]
    combined = sensor_combined(IMU_NS, RATES, force)
    combined["accelerometer_timestamp_relative"] = relative
    bag, _, printed = px4(importer, TORQUES | {"sensor_combined": combined})
    assert note in printed
    held = force[-3] if count < COUNT else np.zeros(3)
    np.testing.assert_allclose(bag.specific_force[-1], held, rtol=1e-6)


# --- the rest -----------------------------------------------------------------------------------


def test_the_trim_is_taken_in_flight_and_not_on_the_ground(importer: Importer) -> None:
    motors = np.full((len(COMMAND_NS), 4), np.nan)  # motors that are off
    motors[50:] = 0.1
    motors[70:90] = 0.6
    landed = START + np.array([0, 1_400_000_000, 1_790_000_000])
    topics = {
        "actuator_motors": controls(motors),
        "vehicle_land_detected": status(landed, "landed", [1, 0, 1]),
        "vehicle_status": status(START + np.array([0, 10**9]), "arming_state", [1, 2]),
    }
    _, values, printed = px4(importer, topics, QUAD_X)
    np.testing.assert_allclose(values["actuators.trim"], 0.6, rtol=1e-6)
    assert "in the air for 0.4 s in 1 stretch(es)" in printed
    assert "50 samples lack a value of a channel in use" in printed

    bag = importer(importer.log, "--flight-only").bag
    for t_ns in (bag.imu_t_ns, bag.actuator_t_ns):
        assert t_ns[0] == landed[1]
        assert t_ns[-1] <= landed[2]
    assert (bag.actuators == np.float32(0.6)).all()
    np.testing.assert_array_equal(bag.rates, RATES[280 : 280 + len(bag.rates)].astype(np.float32))


@pytest.mark.parametrize(
    ("name", "gap"), [("airspeed_validated", 0.0), ("airspeed", 0.0), ("airspeed", 100.0)]
)
def test_logged_airspeed_and_its_median_are_used(importer: Importer, name: str, gap: float) -> None:
    """A gap common to all streams does not count as a gap of the airspeed."""
    imu_ns = IMU_NS + int(1e9 * gap) * (np.arange(COUNT) >= COUNT // 2)
    speed = measured(imu_ns[::4], "true_airspeed_m_s", np.linspace(14.0, 16.0, len(COMMAND_NS)))
    topics = {
        "sensor_combined": sensor_combined(imu_ns, RATES, FORCE),
        "vehicle_torque_setpoint": commands(imu_ns[::4], noise(3), "xyz"),
        name: speed,
    }
    bag, values, printed = px4(importer, topics)
    np.testing.assert_array_equal(bag.airspeed, speed["true_airspeed_m_s"])
    assert values["airspeed.type"] == "geometry_msgs/msg/TwistStamped"
    assert values["airspeed.reference"] == pytest.approx(15.0)
    assert "the airspeed is used; in flight its median is 15 m/s" in printed
    plain = importer(importer.log, "--no-airspeed").values
    assert "airspeed.type" not in plain
    assert plain["airspeed.reference"] == pytest.approx(15.0)


@pytest.mark.parametrize("slow", [False, True])
def test_airspeed_outside_the_flight_or_in_hover_is_unused(importer: Importer, slow: bool) -> None:
    """The ground speed replaces the reference, if it is a speed of flight."""
    t_ns = COMMAND_NS if slow else COMMAND_NS[:1] + 10**10
    topics = TORQUES | {
        "airspeed": measured(t_ns, "true_airspeed_m_s", 1.0 if slow else 15.0),
        "vehicle_gps_position": measured(COMMAND_NS, "vel_m_s", 0.5 if slow else 12.5),
    }
    _, values, printed = px4(importer, topics)
    assert "airspeed.type" not in values
    assert ("airspeed.reference" not in values) if slow else values["airspeed.reference"] == 12.5
    assert "the airspeed is not used" in printed
    assert ("no speed of flight is in the log: set airspeed.reference" in printed) == slow
    assert ("airspeed.reference is the median speed over ground" in printed) != slow
    assert "structure" not in values


def test_tables_of_ulog2csv_give_the_samples_of_their_log(importer: Importer) -> None:
    """The tables come from pyulog's converter."""
    whole, values, _ = px4(importer, MOTORS, QUAD_X)
    folder = importer.folder / "tables"
    folder.mkdir()
    convert_ulog2csv(str(importer.log), None, str(folder), ",", None, None)
    lines = "".join(f"{name},{value}\n" for name, value in QUAD_X.items())
    (folder / "flight_params.csv").write_text(lines)
    again, found, printed = importer(folder)
    np.testing.assert_array_equal(again.imu_t_ns, whole.imu_t_ns)
    np.testing.assert_array_equal(again.actuator_t_ns, whole.actuator_t_ns)
    np.testing.assert_allclose(again.rates, whole.rates, rtol=1e-6)
    np.testing.assert_allclose(again.actuators, whole.actuators, rtol=1e-6)
    assert found["actuators.mixing.de"] == values["actuators.mixing.de"]
    assert "PX4, by ulog2csv" in printed
    (folder / "flight_params.csv").write_text("name,value\n" + lines)
    assert "flight_params.csv' cannot be read: each line needs a" in importer.refused(folder)
    (folder / "flight_params.csv").unlink()
    assert "no parameter (CA_ROTOR*, CA_SV_CS*) says" in importer.refused(folder)
    (folder / "other_sensor_combined_0.csv").write_text("timestamp\n1\n")
    assert "has the tables of several logs, flight, other" in importer.refused(folder)


def test_attitude_arming_mode_and_rate_setpoints_are_imported(importer: Importer) -> None:
    seldom = IMU_NS[::20]
    yaw = np.linspace(3.0, 3.4, 20)  # through 180 deg, where the quaternion changes its sign
    ones = np.ones_like(yaw)
    q = quaternions(0.3 * ones, -0.2 * ones, np.remainder(yaw + np.pi, 2 * np.pi) - np.pi)
    armed_ns = int(IMU_NS[100])
    requested = np.float32(RATES[::20] + 0.5)
    topics = TORQUES | {
        "vehicle_attitude": commands(seldom + 30_000, q[:, [3, 0, 1, 2]], "q", delay_us=30),
        "vehicle_status": status(IMU_NS[[0, 100, 120]], "arming_state", [1, 2, 2])
        | {"nav_state": np.array([0, 15, 15], np.uint8)},
        "vehicle_rates_setpoint": {
            "timestamp": stamps(seldom),
            **dict(zip(("roll", "pitch", "yaw"), requested.T, strict=True)),
        },
    }
    result = px4(importer, topics, {"MC_ROLLRATE_P": 0.15})
    assert result.values["armed.type"] == "std_msgs/msg/Bool"
    assert "MC_ROLLRATE_P 0.15" in (result.folder / "identifier.yaml").read_text()
    states = result.bag.armed
    assert all(armed == (t >= armed_ns) for t, armed in states)
    assert (armed_ns, True) in states and len(states) == 3
    assert result.bag.mode == [(int(IMU_NS[0]), "manual"), (armed_ns, "stabilized")]
    read = decoded(result.folder)
    vectors = [m.vector for _, m in read["/setpoint/rates"]]
    np.testing.assert_allclose([(v.x, v.y, v.z) for v in vectors], requested)
    imu = [m for _, m in read["/imu/data"]]
    o = imu[110].orientation  # between two samples of the attitude
    middle = quaternions(*(np.array([angle]) for angle in (0.3, -0.2, yaw[5:7].mean())))[0]
    assert abs(np.dot([o.x, o.y, o.z, o.w], middle)) == pytest.approx(1.0, abs=1e-6)
    assert imu[0].orientation_covariance[0] == 0.0


def test_the_lever_arm_is_imported_and_the_trim_can_be_learned(importer: Importer) -> None:
    values = {"EKF2_IMU_POS_X": 0.05, "EKF2_IMU_POS_Z": -0.02}
    found = px4(importer, TORQUES, values, "--trim", "learn").values
    np.testing.assert_allclose(found["imu.lever_arm"], [0.05, 0.0, -0.02], rtol=1e-6)
    assert found["actuators.learn_trim_time"] == 2.0


def test_dropouts_gaps_and_repeated_stamps_are_listed(importer: Importer) -> None:
    kept = np.r_[0:101, 131:201, 212:COUNT]
    twice = np.append(COMMAND_NS, COMMAND_NS[20])
    topics = {
        ("sensor_combined", 0): sensor_combined(IMU_NS[kept], RATES[kept], FORCE[kept]),
        ("vehicle_torque_setpoint", 0): commands(twice, np.zeros((101, 3)), "xyz"),
    }
    dropouts = ((100_500_000, 150), (100_600_000, 20))
    log = write_ulog(importer.folder / "gaps.ulg", topics, {}, dropouts)
    printed = importer(log).printed
    assert "the logger lost messages 2 times, together 0.17 s, at most 0.15 s" in printed
    assert "rates: 359 samples over 2.0 s at 200 Hz" in printed
    assert "2 gaps of more than 0.02 s, together 0.215 s, the longest 0.155 s at 100.50" in printed
    assert "actuators: 1 stamps repeat the one before" in printed


@pytest.mark.skipif(not SAMPLE.exists(), reason="../shared/logs/px4_quad_sample.ulg is not there")
def test_a_recorded_log_has_no_significant_derivatives(tmp_path: Path, importer: Importer) -> None:
    """The log is of 2016, in the old format. The vehicle was moved by hand, disarmed."""
    bag, _, printed = importer(SAMPLE)
    log = ULog(str(SAMPLE))
    gyro = log.get_dataset("sensor_combined").data
    controls = log.get_dataset("actuator_controls_0").data
    np.testing.assert_array_equal(bag.imu_t_ns // 1000, gyro["timestamp"])
    np.testing.assert_array_equal(bag.rates[:, 1], gyro["gyro_rad[1]"])
    np.testing.assert_array_equal(bag.specific_force[:, 2], gyro["accelerometer_m_s2[2]"])
    np.testing.assert_array_equal(bag.actuator_t_ns // 1000, controls["timestamp"])
    np.testing.assert_array_equal(bag.actuators[:, 1], controls["control[1]"])
    assert "17070 samples over 68.9 s at 250 Hz" in printed
    assert "never armed" in printed
    assert "SENS_BOARD_ROT 0, none, fine offsets -1.50 1.19 0.00 deg" in printed
    assert "the logger lost messages 4 times" in printed
    options = ("--actuators-topic", "actuator_outputs", "--trim", "neutral")
    bag, values, printed = importer(SAMPLE, *options)
    assert "a quadrotor in X" in printed
    np.testing.assert_allclose(mixing(values), QUADROTOR.mixing, atol=1e-12)
    np.testing.assert_allclose(values["actuators.scale"], 1.0 / (1950.0 - 1075.0))
    assert values["actuators.trim"] == [1075.0] * 4
    assert (bag.actuators[:, :4] == 900.0).all()
    assert "it never flew: leave --flight-only out" in importer.refused(SAMPLE, "--flight-only")
    # the vehicle moves without its motors: no control derivative may be significant
    recorded, output = importer.folder / "bag_1", tmp_path / "replayed"
    parameters, text = recorded / "unarmed.yaml", (recorded / "identifier.yaml").read_text()
    parameters.write_text(re.sub(r"armed.type: .*", 'armed.type: ""', text))
    with Bag(recorded) as opened:
        end_ns = opened.start_ns + 30 * SECOND_NS
        first = [m for m in opened.messages(opened.types) if m.log_ns < end_ns]
        moved = written(tmp_path / "moved", opened.types, first)
    assert replay(moved, output, by=parameters) == NOT_USABLE
    found = summary(output)["coefficients"]
    assert found["pdot/p"]["value"] != 0.0  # the estimator has learned
    for name in ("pdot/da", "qdot/de", "rdot/dr"):
        assert abs(found[name]["value"]) < 3.0 * found[name]["sigma"]
