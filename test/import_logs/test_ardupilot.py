# SPDX-License-Identifier: Apache-2.0
"""Import of ArduPilot logs of different vehicles."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataflash_writing import OLD_FORMATS, Rows, servos, write_dataflash
from excerpts import decoded
from imported import Imported, Importer, mixing

from uav_ident_ros.identification.frames import quaternions
from uav_ident_ros.simulation.channels import QUADROTOR

START, STEP, COUNT = 20_000_000, 4000, 300
IMU_US = START + STEP * np.arange(COUNT)
COMMAND_US = IMU_US[::5]
RATES = np.random.default_rng(1).normal(size=(COUNT, 3)).astype(np.float32).astype(float)
FORCE = np.tile(np.array([0.25, -0.5, -9.75]), (COUNT, 1))
PULSES = np.random.default_rng(2).integers(1200, 1800, (len(COMMAND_US), 4))


def at(t_us: np.ndarray, name: str, values: Any) -> Rows:
    """Return messages of a type, one at each time."""
    rows = np.broadcast_to(values, (len(t_us), np.shape(values)[-1]))
    return [(int(t), name, tuple(row.tolist())) for t, row in zip(t_us, rows, strict=True)]


def imu(instance: int = 0, factor: float = 1.0) -> Rows:
    which = np.full((COUNT, 1), instance)
    return at(IMU_US, "IMU", np.hstack([which, factor * RATES, FORCE]))


def rcou(every: int = 1, pulses: np.ndarray = PULSES) -> Rows:
    return at(COMMAND_US[::every], "RCOU", pulses[::every])


PLANE = servos(4, 19, 70, 21, AHRS_ORIENTATION=8)


TITLE = [(START, "MSG", (b"ArduCopter V4.5.7 (0358a9c2)",))]
QUAD = servos(33, 34, 35, 36) | {"FRAME_CLASS": 1, "FRAME_TYPE": 1}


def imported(
    importer: Importer,
    rows: Rows,  # Messages beside those of the IMU and the pins
    values: dict,
    *options: str,
    pulses: Rows | None = None,  # RCOU, if not the usual
) -> Imported:
    every = rows + imu() + (rcou() if pulses is None else pulses)
    return importer(write_dataflash(importer.folder / "flight.bin", every, values), *options)


# --- outputs ------------------------------------------------------------------------------------


def test_servo_ranges_and_reversals_of_a_plane_set_scale_and_mixing(importer: Importer) -> None:
    values = PLANE | {"SERVO2_REVERSED": 1, "SERVO2_TRIM": 1480, "SERVO4_MIN": 1000}
    bag, found, printed = imported(importer, [], values, "--trim", "neutral")
    assert bag.names[:4] == ["aileron", "elevator", "throttle", "rudder"]
    np.testing.assert_array_equal(bag.actuators, PULSES)
    np.testing.assert_allclose(
        found["actuators.scale"], [2 / 800, -2 / 800, 1 / 800, 2 / 900], rtol=1e-12
    )
    np.testing.assert_allclose(found["actuators.trim"], [1500, 1480, 1100, 1500])
    np.testing.assert_allclose(
        mixing(found), [[0, -1, 0, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 0, 1, 0]]
    )
    assert (
        "elevator: SERVO2_FUNCTION 19, 1100 1480 1900 us, reversed; us less 1480, times -0.0025"
    ) in printed
    assert "de (nose down) = -1 elevator" in printed
    assert "elevator: one unit is half of 1100 to 1900 us to either side" in printed
    assert "AHRS_ORIENTATION 8, roll 180 deg" in printed
    assert "the logger lost" not in printed
    assert "structure" not in found  # an aeroplane's: the default


def test_pins_beyond_the_fourteenth_are_read(importer: Importer) -> None:
    """A message without pins in use adds no channel."""
    rudder = np.random.default_rng(3).integers(1200, 1800, (len(COMMAND_US), 1))
    more = at(COMMAND_US, "RCO2", rudder) + at(COMMAND_US, "RCO3", PULSES[:, :2])
    values = servos(4, 19, 70) | {
        name.replace("SERVO1_", "SERVO15_"): value for name, value in servos(21).items()
    }
    bag, found, _ = imported(importer, more, values, pulses=rcou(pulses=PULSES[:, :3]))
    assert bag.names[:4] == ["aileron", "elevator", "throttle", "rudder"]
    np.testing.assert_array_equal(bag.actuators, np.hstack([PULSES[:, :3], rudder]))
    np.testing.assert_allclose(mixing(found)[1], [0, 0, 0, -1])


ELEVON, TAIL = [-0.5, -0.5], [-0.5, 0.5]
"""Plane's mixer gives each surface of a pair half of either demand (MIXING_GAIN)."""

MIXERS = {
    # functions of the pins, parameters, and rows of the mixing
    "elevons": ((77, 78, 70), {}, [[*ELEVON, 0], [0] * 3, [-0.5, 0.5, 0], [0, 0, 1]]),
    "V-tail": ((79, 80), {}, [ELEVON, TAIL, [0, 0], [0, 0]]),
    "two of one function": ((4, 4, 19), {}, [[0, 0, -1], [0] * 3, [0.5, 0.5, 0], [0] * 3]),
    "quadrotor": ((33, 34, 35, 36), QUAD, QUADROTOR.mixing),
}


@pytest.mark.parametrize("name", MIXERS)
def test_surface_pairs_and_motors_mix_as_in_ardupilot(importer: Importer, name: str) -> None:
    functions, more, rows = MIXERS[name]
    bag, values, _ = imported(importer, [], servos(*functions) | more)
    np.testing.assert_allclose(mixing(values), rows, atol=1e-12)
    if name == "two of one function":
        assert bag.names[:2] == ["aileron", "aileron_2"]


@pytest.mark.parametrize(("frame", "count"), [((2, 1), 6), ((3, 1), 8), ((4, 1), 8), ((1, 0), 4)])
def test_mixing_rows_of_the_frames_are_orthogonal(importer: Importer, frame, count: int) -> None:
    """The collective causes no moment, and the three moments are independent."""
    pulses = np.random.default_rng(3).integers(1200, 1800, (len(COMMAND_US), count))
    values = servos(*range(33, 33 + count)) | {"FRAME_CLASS": frame[0], "FRAME_TYPE": frame[1]}
    found = imported(importer, [], values, pulses=rcou(pulses=pulses)).values
    rows = mixing(found)
    gram = rows @ rows.T
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-12)
    np.testing.assert_allclose(np.abs(rows).sum(axis=1), [2.0, 2.0, 2.0, 1.0])


def test_demands_before_the_mixer_replace_slow_pulse_widths(importer: Importer) -> None:
    requested = np.array([0.1, -0.2, 0.3, 0.4])
    out = (0, 0, 0.1, 0, 0, -0.2, 0, 0, 0.3, 0, 0, 0.4)
    rates = at(COMMAND_US, "RATE", out)
    bag, values, printed = imported(importer, rates, QUAD, pulses=rcou(10))
    assert (
        "RCOU is logged at 5 Hz only (LOG_BITMASK); RATE is at 50 Hz, before the mixer, and does "
        "not show saturation"
    ) in printed
    assert bag.names == ["roll", "pitch", "yaw", "throttle"]
    np.testing.assert_allclose(bag.actuators, np.tile(requested, (len(COMMAND_US), 1)), rtol=1e-6)
    np.testing.assert_allclose(mixing(values) @ requested, [0.2, -0.3, 0.1, 0.4])
    unknown = imported(importer, rates, QUAD | {"FRAME_CLASS": 7})
    assert "RCOU is passed over" in unknown.printed


def test_pulse_widths_are_preferred_to_demands_of_the_same_slow_rate(importer: Importer) -> None:
    """One loop logs both at about 10 Hz: their median intervals differ by 0.4 %."""
    slow = COMMAND_US[::5]
    rates = at(slow - (slow - slow[0]) // 250, "RATE", np.full(12, 0.1))
    _, values, printed = imported(importer, rates, QUAD, pulses=rcou(5))
    assert (
        "RCOU is taken; of the flight there is RCOU at 10 Hz over 100 %, RATE at 10.04" in printed
    )
    np.testing.assert_allclose(mixing(values), QUADROTOR.mixing, atol=1e-12)


@pytest.mark.parametrize(
    ("mask", "every", "advice"),
    [(830, 1, ": make it 831,"), (831, 1, ", although it has"), (830, 20, ": make it 262975,")],
)
def test_the_note_on_slow_messages_names_the_bit_of_log_bitmask(
    importer: Importer, mask: int, every: int, advice: str
) -> None:
    """The last value, if set, must also cure a problem before it, as of a slow gyro."""
    messages, values = TITLE + imu()[::every] + rcou(10), QUAD | {"LOG_BITMASK": mask}
    printed = importer(write_dataflash(importer.folder / "slow.bin", messages, values)).printed
    needed = f"20 Hz are needed (LOG_BITMASK {mask}{advice} 'fast attitude')"
    assert f"{needed}, which logs RATE in its place" in printed
    slow = "IMU has 12.5 Hz only: 20 Hz are needed (LOG_BITMASK 830: make it 262974"
    assert (slow in printed) == (every == 20)


def test_surfaces_are_the_inputs_of_a_quadplane_unless_rate_is_selected(
    importer: Importer,
) -> None:
    """RATE is logged fast, but holds the demands on the lift motors alone."""
    values = servos(4, 19, 70, 21, 33, 34, 35, 36)
    rows = [(START, "MSG", (b"ArduPlane V4.5.7 (0358a9c2)",))]
    rows += at(COMMAND_US, "RATE", (0, 0, 0.1) * 4)
    rows += at(COMMAND_US[::10], "AETR", (450.0, -900.0, 60.0, 225.0))
    bag, found, printed = imported(importer, rows, values, pulses=rcou(10))
    assert bag.names[:4] == ["aileron", "elevator", "throttle", "rudder"]
    assert "structure" not in found
    assert "RATE, the demands on its lift motors, is passed over" in printed
    hover = importer(importer.log, "--actuators-topic", "RATE")
    assert hover.bag.names == ["roll", "pitch", "yaw", "throttle"]
    assert hover.values["structure"] == "augmented"
    mixed = importer(importer.log, "--actuators-topic", "AETR")
    u = mixing(mixed.values) @ (np.array(mixed.values["actuators.scale"]) * mixed.bag.actuators[0])
    np.testing.assert_allclose(u, [0.2, -0.05, 0.1, 0.6])


# --- rates --------------------------------------------------------------------------------------


def test_raw_rates_are_preferred_and_stamped_when_sampled(importer: Importer) -> None:
    sampled = np.column_stack([np.zeros(COUNT), IMU_US])
    raw = at(IMU_US + 900, "GYR", np.hstack([sampled, 2.0 * RATES]))
    raw += at(IMU_US + 900, "ACC", np.hstack([sampled, FORCE]))
    bag, _, printed = imported(importer, raw, PLANE)
    np.testing.assert_array_equal(bag.imu_t_ns, IMU_US * 1000)
    np.testing.assert_array_equal(bag.rates, 2.0 * RATES)
    np.testing.assert_array_equal(bag.specific_force, FORCE)
    assert "of the flight there is GYR at 250 Hz over 100 %, IMU at 250 Hz over 100 %" in printed
    assert "low-passed" not in printed


def test_an_option_selects_the_imu_instance(importer: Importer) -> None:
    bag, _, printed = imported(importer, imu(1, 3.0), PLANE, "--rates-instance", "1")
    np.testing.assert_allclose(bag.rates, 3.0 * RATES, rtol=1e-6)
    assert "instances [0, 1] of IMU" in printed
    assert "instance 2); it has" in importer.refused(importer.log, "--rates-instance", "2")
    assert "one set of actuators" in importer.refused(importer.log, "--actuators-instance", "1")


# --- the rest -----------------------------------------------------------------------------------


def test_trim_airspeed_lever_arm_and_lost_messages_are_imported(importer: Importer) -> None:
    pulses = PULSES.copy()
    pulses[:30] = 1100  # on the ground
    armed_us = int(COMMAND_US[30])
    rows = [
        (START, "ARM", (0,)),
        (armed_us, "ARM", (1,)),
        (armed_us, "CTUN", (0, 0, 0, 0, 0, 0, 0, 0, 0, 1.25)),
        (int(IMU_US[-1]), "DSF", (7,)),
        *at(COMMAND_US[30:], "ARSP", (0, 16.0)),
    ]
    values = PLANE | {"INS_POS1_X": 0.1, "INS_POS1_Z": -0.05}
    bag, found, printed = imported(importer, rows, values, "--airspeed", pulses=rcou(pulses=pulses))
    np.testing.assert_allclose(found["actuators.trim"], np.median(pulses[30:], axis=0))
    np.testing.assert_allclose(bag.airspeed, 20.0)
    assert found["airspeed.reference"] == 20.0
    np.testing.assert_allclose(found["imu.lever_arm"], [0.1, 0.0, -0.05], rtol=1e-6)
    assert "the logger lost 7 messages" in printed
    assert "ARSP.Airspeed times CTUN.E2T" in printed


@pytest.mark.parametrize("scale", [1.0, 4500.0])
def test_attitude_mode_and_rate_setpoints_are_imported(importer: Importer, scale: float) -> None:
    """Old logs scale controls to 4500, and rate setpoints to hundredths of a degree a second."""
    unit = 1.0 if scale == 1.0 else 100.0
    requested = (30.0 * unit, 0, 0.1 * scale, -20.0 * unit, 0, 0, 10.0 * unit, 0, 0, 0, 0, 0.4)
    rows = at(COMMAND_US, "RATE", requested)
    rows += at(COMMAND_US[[0, 9]], "MODE", [(5, 5, 1), (99, 99, 1)])
    rows += at(IMU_US, "ATT", (0, 3000, 0, -1000, 0, 9000))
    rows.append((START, "MSG", (b"ArduPlane V4.5.7 (0358a9c2)",)))
    result = imported(importer, rows, PLANE)
    assert result.bag.mode == [(START * 1000, "fbwa"), (int(COMMAND_US[9]) * 1000, "Mode 99")]
    read = decoded(result.folder)
    o = read["/imu/data"][0][1].orientation
    expected = quaternions(*np.radians([30.0, -10.0, 90.0]))
    np.testing.assert_allclose([o.x, o.y, o.z, o.w], expected, atol=1e-12)
    vector = read["/setpoint/rates"][0][1].vector
    np.testing.assert_allclose(np.degrees([vector.x, vector.y, vector.z]), [30, -20, 10], rtol=1e-6)


@pytest.mark.parametrize(
    ("rows", "flown", "note"),
    [
        ([(0, "ARM", 1), (100, "STAT", 0), (150, "STAT", 1), (250, "STAT", 0)], (150, 250),
         "in the air for 0.4 s in 1 stretch(es) (STAT.isFlying)"),
        ([(0, "EV", 10), (100, "EV", 28), (200, "EV", 17), (200, "EV", 18), (250, "EV", 11)],
         (100, 200), "in the air for 0.4 s in 1 stretch(es) (EV)"),
        ([(50, "EV", 10), (250, "EV", 11)], (50, 250), "armed for 0.8 s in 1 stretch(es) (EV)"),
        ([(100, "EV", 28), (200, "EV", 18)], (100, 200), "in the air for 0.4 s"),
        ([(0, "ARM", 1), (100, "STAT", 0)], (0, 0),
         "never in the air (STAT.isFlying): this log gives no model; if it did fly, empty"),
        ([(200, "ARM", 0)], (0, 200), "armed for 0.8 s in 1 stretch(es) (ARM)"),  # begins in flight
        ([(200, "EV", 15)], None, "the log does not say when it flew"),
    ],
)  # fmt: skip
def test_the_armed_topic_is_true_in_flight_alone(
    importer: Importer, rows: Rows, flown: tuple[int, int] | None, note: str
) -> None:
    """An armed plane may taxi, and an armed copter may stand."""
    events = [(int(IMU_US[at]), kind, (state, 0, 0, 0)[:size])
              for at, kind, state in rows
              for size in [{"ARM": 4, "STAT": 1, "EV": 1}[kind]]]  # fmt: skip
    result = imported(importer, events, PLANE)
    assert note in result.printed
    assert ("armed.type" in result.values) == (flown is not None)
    states = result.bag.armed
    if flown is None:
        assert not states
        return
    begin, end = (1000 * int(IMU_US[at]) for at in flown)
    assert states and all(state == (begin <= t < end) for t, state in states)
    assert begin == end or {(begin, True), (end, False)} <= {*states}


def test_a_parameter_change_during_the_log_is_noted(importer: Importer) -> None:
    later = [(25_000_000, "PARM", (b"SERVO1_TRIM", 1520.0, float("nan")))]
    printed = imported(importer, later, PLANE).printed
    assert "SERVO1_TRIM became 1520 at 25.0 s: the first value is used" in printed


# --- logs of 2014 -------------------------------------------------------------------------------


def old_log(
    folder: Path, firmware: str, values: dict[str, float], text: str = "", scale: float = 4500
) -> Path:
    """Write a log of 2014: stamps in ms, no pin functions, demands as large integers."""
    imu_ms, command_ms = IMU_US // 1000, COMMAND_US // 1000
    requested = (0, 0, 0.1 * scale, 0, 0, -0.2 * scale, 0, 0, 0.3 * scale, 0, 0, 400.0)
    rows: Rows = [(0, "MSG", (note.encode(),)) for note in (firmware, text) if note]
    rows += at(imu_ms, "IMU", np.hstack([RATES, FORCE]))
    rows += at(imu_ms, "IMU2", np.hstack([3.0 * RATES, FORCE]))
    rows += at(command_ms, "RCOU", np.hstack([PULSES, 0 * PULSES]))
    rows += at(command_ms, "RATE", requested)
    rows += [(int(imu_ms[0]), "ARM", (1, 0))]
    # TimeMS of GPS is the time of the week, T that since the start
    rows += [(int(t), "GPS", (3, 400_000_000 + t, 1871, 18.0, t)) for t in command_ms[::10]]
    return write_dataflash(folder / "old.bin", rows, values, OLD_FORMATS)


COPTER = {"RC3_MIN": 1100, "RC3_MAX": 1900}


def test_a_copter_log_of_2014_has_the_mixing_of_its_frame(importer: Importer) -> None:
    log = old_log(importer.folder, "ArduCopter V3.2 (c8e0f3e1)", COPTER | {"FRAME": 1})
    bag, values, printed = importer(log, "--rates-instance", "1")
    np.testing.assert_array_equal(bag.imu_t_ns, IMU_US * 1000)
    np.testing.assert_allclose(bag.rates, 3.0 * RATES, rtol=1e-6)
    np.testing.assert_array_equal(bag.actuators[:, :4], PULSES)
    np.testing.assert_allclose(mixing(values), QUADROTOR.mixing, atol=1e-12)
    np.testing.assert_allclose(values["actuators.scale"], 1 / 800)
    assert values["structure"] == "augmented"  # no wings: no angle of attack
    assert "4 pins carry pulses: they are its motors" in printed
    assert "the motors are on the pins of their numbers" in printed


def test_the_front_motors_of_a_v_frame_have_the_smaller_yaw_effect(importer: Importer) -> None:
    frame = COPTER | {"FRAME": 2}
    log = old_log(importer.folder, "ArduCopter V3.2.1 (36b405fb)", frame, "Frame: QUAD")
    _, values, printed = importer(log)
    assert "quad v with ArduPilot's motor order" in printed
    de, dr, da, dth = mixing(values)
    np.testing.assert_allclose([de, da, dth], QUADROTOR.mixing[[0, 2, 3]], atol=1e-12)
    np.testing.assert_allclose(dr[[0, 2]] / dr[[1, 3]], [0.7981, 0.7981])


def test_the_demands_are_the_inputs_of_a_copter_of_unknown_frame(importer: Importer) -> None:
    log = old_log(importer.folder, "APM:Copter V3.3.3 (acf98493)", {"FRAME": 10}, "Frame: Y6")
    bag, values, printed = importer(log)
    u = mixing(values) @ (np.array(values["actuators.scale"]) * bag.actuators[0])
    np.testing.assert_allclose(u, [0.2, -0.3, 0.1, 0.4], rtol=1e-6)
    assert "RCOU is passed over: no SERVOn_FUNCTION names a surface or a motor" in printed
    assert "RATE: full demand is 4500, full throttle 1000, as before Copter 3.4" in printed


def test_surfaces_of_a_plane_log_of_2014_follow_from_the_sticks(importer: Importer) -> None:
    sticks = {"RCMAP_ROLL": 1, "RCMAP_PITCH": 2, "RCMAP_THROTTLE": 3, "RCMAP_YAW": 4}
    ranges = {f"RC{i}_{end}": v for i in range(1, 5)
              for end, v in (("MIN", 1100), ("TRIM", 1500), ("MAX", 1900), ("REV", 1))}  # fmt: skip
    log = old_log(importer.folder, "ArduPlane V3.2.0 (abc)", sticks | ranges | {"RC2_REV": -1})
    _, values, printed = importer(log)
    assert values["actuators.channels"] == ["aileron", "elevator", "throttle", "rudder"]
    np.testing.assert_allclose(
        values["actuators.scale"], [2 / 800, -2 / 800, 1 / 800, 2 / 800], rtol=1e-12
    )
    assert "are on the pins of their sticks (RCMAP_*)" in printed
    assert values["airspeed.reference"] == 18.0
    assert "armed for 1.2 s in 1 stretch(es) (ARM)" in printed


def test_the_demands_replace_paired_surfaces_in_logs_of_2014(importer: Importer) -> None:
    log = old_log(importer.folder, "ArduPlane V3.2.0 (abc)", {"ELEVON_OUTPUT": 1}, scale=1.0)
    result = importer(log)
    assert "ELEVON_OUTPUT is 1: how such pairs turn is not known" in result.printed
    assert result.values["actuators.channels"][0] == "roll"
