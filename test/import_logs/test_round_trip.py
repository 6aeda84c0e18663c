# SPDX-License-Identifier: Apache-2.0
"""A simulated flight, written into a log of each kind and imported: samples and inputs are equal
within the resolution of the format."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataflash_writing import Rows, servos, write_dataflash
from excerpts import BAGS, replay, summary
from good_logs import table
from imported import Imported, Importer, contents, flight, mixing
from ulog_writing import commands, padded, sensor_combined, stamps, write_ulog

from uav_ident_ros.import_logs.writing import FIRST_NS
from uav_ident_ros.simulation.noise import Measurements

PUBLICATION_DELAY = 300
"""us."""

FIXED_WING = {
    "CA_AIRFRAME": 1, "CA_ROTOR_COUNT": 1, "CA_SV_CS_COUNT": 3, "SENS_BOARD_ROT": 0,
    "CA_SV_CS0_TYPE": 3, "CA_SV_CS0_TRQ_P": 1.0, "CA_SV_CS1_TYPE": 4, "CA_SV_CS1_TRQ_Y": 1.0,
    "CA_SV_CS2_TYPE": 15, "CA_SV_CS2_TRQ_R": 1.0,
}  # fmt: skip

PLANE = servos(19, 21, 4, 70, SERVO2_REVERSED=1, INS_GYRO_FILTER=20.0)

PLAIN_SIGNS = np.array([-1.0, -1.0, 1.0, 1.0])
"""Signs of elevator, rudder, aileron and throttle in the autopilots, relative to the simulation."""


@pytest.fixture(scope="module")
def measured() -> Measurements:
    return flight()


def px4_topics(measured: Any, *actuators: tuple[str, np.ndarray, str]) -> dict:
    columns = sensor_combined(measured.imu_t_ns, measured.rates, measured.specific_force)
    topics = {("sensor_combined", 0): columns}
    for name, values, field in actuators:
        topics[name, 0] = commands(measured.actuator_t_ns, values, field, PUBLICATION_DELAY)
    return topics


def allocated(measured: Any) -> dict:
    values = measured.actuators * PLAIN_SIGNS
    return px4_topics(
        measured,
        ("actuator_motors", padded(values[:, 3:], 12), "control"),
        ("actuator_servos", padded(values[:, :3], 8), "control"),
    )


def inputs(result: Imported) -> np.ndarray:
    """Return elevator, rudder, aileron and throttle by the identifier's mapping of channels."""
    columns = [result.bag.names.index(name) for name in result.values["actuators.channels"]]
    off_trim = result.bag.actuators[:, columns] - result.values["actuators.trim"]
    return (off_trim * result.values["actuators.scale"]) @ mixing(result.values).T


Written = tuple[list[str], np.ndarray]
"""Arguments that import a log, and the commands in it."""


def px4_log(folder: Path, measured: Measurements) -> Written:
    raw = (measured.actuators * PLAIN_SIGNS)[:, [3, 0, 1, 2]]
    log = write_ulog(folder / "new.ulg", allocated(measured), FIXED_WING)
    return [str(log)], raw.astype(np.float32)


def ardupilot_log(folder: Path, measured: Measurements) -> Written:
    """Write single floats, and commands in whole microseconds, 800 for the whole range."""
    signs = PLAIN_SIGNS * [1.0, -1.0, 1.0, 1.0]  # the rudder is reversed
    pulses = np.rint([1500, 1500, 1500, 1100] + [400, 400, 400, 800] * measured.actuators * signs)
    moved = np.hstack([measured.rates, measured.specific_force]).tolist()
    rows: Rows = [(0, "MSG", (b"ArduPlane V4.5.0 (test)",))]
    rows += [
        (int(t), "IMU", (0, *v)) for t, v in zip(stamps(measured.imu_t_ns), moved, strict=True)
    ]
    written_us = stamps(measured.actuator_t_ns)
    rows += [(int(t), "RCOU", tuple(v)) for t, v in zip(written_us, pulses, strict=True)]
    return [str(write_dataflash(folder / "plane.bin", rows, PLANE))], pulses


def csv_log(folder: Path, measured: Measurements) -> Written:
    """Write both streams into one table, with empty cells where a stream has no sample."""
    cells: dict[int, list[str]] = {}
    moved = np.hstack([measured.rates, measured.specific_force])
    for t_ns, values, first in (
        (measured.imu_t_ns, moved, 0), (measured.actuator_t_ns, measured.actuators, 6)
    ):  # fmt: skip
        for t, row in zip(t_ns.tolist(), values.tolist(), strict=True):
            cells.setdefault(t, [""] * 10)[first : first + len(row)] = map(repr, row)
    lines = ["t,p,q,r,ax,ay,az,elevator,rudder,aileron,throttle"]
    lines += [",".join([f"{t // 10**9}.{t % 10**9:09d}", *row]) for t, row in sorted(cells.items())]
    return table(folder, "\n".join(lines) + "\n", COLUMNS), measured.actuators


COLUMNS = """\
time: {column: t, unit: s}
axes: frd
rates: {columns: [p, q, r], unit: rad/s}
specific_force: {columns: [ax, ay, az]}
channels:
  elevator: {de: 1.0}
  rudder: {dr: 1.0}
  aileron: {da: 1.0}
  throttle: {dth: 1.0}
"""

CHANNELS = ["elevator", "rudder", "aileron", "throttle"]

LOGS = {
    # writer, type of the rates, resolution of the inputs, channels, notes
    "px4": (px4_log, np.float32, 1e-7, ["motor_1", *CHANNELS[:3]],
            ["0.30 ms after the gyro sample"]),
    "ardupilot": (ardupilot_log, np.float32, 2.0 / 800.0, CHANNELS,
                  ["ArduPlane V4.5.0", "low-passed at 20 Hz (INS_GYRO_FILTER)"]),
    "table": (csv_log, np.float64, 0.0, CHANNELS, []),
}  # fmt: skip


@pytest.mark.parametrize("kind", LOGS)
def test_round_trip(tmp_path: Path, measured: Measurements, importer: Importer, kind: str) -> None:
    """A table holds every bit, nanoseconds since 1970 included."""
    write, dtype, inputs_off, names, notes = LOGS[kind]
    arguments, raw = write(tmp_path, measured)
    result = importer(*arguments)
    bag = result.bag
    np.testing.assert_array_equal(bag.imu_t_ns, measured.imu_t_ns)
    np.testing.assert_array_equal(bag.rates, measured.rates.astype(dtype))
    np.testing.assert_array_equal(bag.specific_force, measured.specific_force.astype(dtype))
    assert bag.frame_ids == {"base_link_frd"}
    np.testing.assert_array_equal(bag.actuator_t_ns, measured.actuator_t_ns)
    np.testing.assert_array_equal(bag.actuators, raw)
    assert bag.names == names
    expected = measured.actuators - np.median(measured.actuators, axis=0)
    np.testing.assert_allclose(inputs(result), expected, rtol=0.0, atol=inputs_off)
    assert all(note in result.printed for note in notes)


@pytest.mark.parametrize(
    "thinned", [("actuator_motors", "actuator_servos"), ("actuator_servos",)], ids=" ".join
)
def test_px4_setpoints_replace_actuators_logged_at_a_low_rate(
    tmp_path: Path, measured, importer: Importer, thinned: tuple[str, ...]
) -> None:
    """PX4's default profile logs actuators at 10 Hz and setpoints at 50 Hz; the profile for
    system identification logs all motor messages, but not all servo messages."""
    topics = allocated(measured)
    for name in thinned:
        topics[name, 0] = {field: v[::5] for field, v in topics[name, 0].items()}
    torque = (measured.actuators * PLAIN_SIGNS)[:, [2, 0, 1]]
    thrust = np.zeros((len(torque), 3))
    thrust[:, 0] = measured.actuators[:, 3]
    topics |= px4_topics(
        measured,
        ("vehicle_torque_setpoint", torque, "xyz"),
        ("vehicle_thrust_setpoint", thrust, "xyz"),
    )
    log = write_ulog(tmp_path / "default.ulg", topics, FIXED_WING | {"SDLOG_PROFILE": 1})
    imported, values, printed = importer(log)
    advice = "is logged at 10 Hz only (SDLOG_PROFILE 1: make it 17, 'high rate')"
    assert printed.count(f"{thinned[0]} {advice}") == 1
    np.testing.assert_array_equal(imported.actuators[:, :3], torque.astype(np.float32))
    assert values["actuators.channels"] == ["roll_torque", "pitch_torque", "yaw_torque", "thrust_x"]
    np.testing.assert_array_equal(
        mixing(values), [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
    )


OTHER_UNITS = """\
delimiter: ';'
time: {column: ms, unit: ms}
axes: flu
rates: {columns: [P, Q, R], unit: deg/s, counts: 16.4}
specific_force: {columns: [X, Y, Z], unit: g, counts: 2048}
airspeed: {column: kn, unit: kn}
lever_arm: [0.1, 0.0, -0.05]
channels:
  tail: {column: s1, scale: 0.002, neutral: 1500.0, de: 1.0}
"""


def test_table_units_become_si(tmp_path: Path, measured: Measurements, importer: Importer) -> None:
    """The table holds counts of degrees and g, knots, milliseconds."""
    since_start = measured.imu_t_ns - measured.imu_t_ns[0]
    moved = [16.4 * np.degrees(measured.rates), 2048 * measured.specific_force / 9.80665]
    others = np.tile([20.0 / (1852.0 / 3600.0), 1500.0], (len(since_start), 1))
    rows = zip(since_start // 1_000_000, np.hstack([*moved, others]).tolist(), strict=True)
    text = "ms;P;Q;R;X;Y;Z;kn;s1\n"
    text += "\n".join(";".join([str(t), *map(repr, row)]) for t, row in rows)
    result = importer(*table(tmp_path, text, OTHER_UNITS), "--airspeed")
    imported, values, _ = result
    np.testing.assert_allclose(imported.rates, measured.rates, rtol=1e-12)
    np.testing.assert_allclose(imported.specific_force, measured.specific_force, rtol=1e-12)
    np.testing.assert_allclose(imported.airspeed, 20.0, rtol=1e-12)
    np.testing.assert_array_equal(imported.imu_t_ns, np.maximum(since_start, FIRST_NS))
    replay(result.folder, tmp_path / "out", by=result.folder / "identifier.yaml")
    inputs = summary(tmp_path / "out")["inputs"]
    assert all(entry["dropped"] == {} for entry in inputs.values())  # including the first row
    assert imported.frame_ids == {"base_link"}
    assert values["imu.convention"] == "flu"
    assert values["imu.lever_arm"] == [0.1, 0.0, -0.05]
    assert values["airspeed.type"] == "geometry_msgs/msg/TwistStamped"
    assert math.isclose(values["airspeed.reference"], 20.0)
    assert values["actuators.trim"] == [1500.0]
    assert values["actuators.mixing.de"] == [1.0]


TO_FRD = np.array([1.0, -1.0, -1.0])

SPEED = 53.3
"""Ground speed of the example flight, m/s: the log has no airspeed."""

DELAY_NS = 60_000_000
"""Delay from the log stamp of a command to its action; the simulation has none."""


def px4_example(folder: Path) -> Path:
    """Write the example flight as a PX4 log, with a delay that the log does not declare."""
    recorded = contents(BAGS / "c172p")
    recorded.actuator_t_ns -= DELAY_NS
    recorded.rates *= TO_FRD
    recorded.specific_force *= TO_FRD
    seldom = stamps(recorded.actuator_t_ns[::5])
    speed = {"timestamp": seldom, "vel_m_s": np.full(len(seldom), SPEED, np.float32)}
    topics = allocated(recorded) | {("vehicle_gps_position", 0): speed}
    return write_ulog(folder / "c172p.ulg", topics, FIXED_WING)


def test_an_imported_log_is_usable_with_the_coefficients_of_its_flight(
    tmp_path: Path, importer: Importer, replayed_example: Path
) -> None:
    """Import and replay run without an option."""
    bag, output = importer(px4_example(tmp_path)).folder, tmp_path / "imported"
    assert replay(bag, output, by=bag / "identifier.yaml") == 0
    imported, recorded = summary(output), summary(replayed_example)
    assert imported["usable"] and recorded["usable"]
    assert imported["inputs"]["rates"]["dropped"] == {}
    assert abs(imported["delay"] - DELAY_NS * 1e-9) < 0.005
    for coefficient in ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr"):
        found, expected = (s["coefficients"][coefficient]["value"] for s in (imported, recorded))
        # 5 ms of delay cost 8 % of the damping in pitch; control derivatives are within 4.5 %:
        # the rest is a margin.
        assert found == pytest.approx(expected, rel=0.05 if "/d" in coefficient else 0.1)
