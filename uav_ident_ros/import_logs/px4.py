# SPDX-License-Identifier: Apache-2.0
"""PX4 logs (`.ulg`): rates, commands, airspeed and what the log says of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import (
    BOOT_TIME,
    ENOUGH_RATE,
    NO_FORCE,
    choose,
    find_messages,
    median_in_flight,
    read_lever_arm,
    read_mode,
    read_setpoint,
    refuse_others,
    say_changes,
    say_instances,
    say_stretches,
    that_explain,
)
from uav_ident_ros.import_logs.flight_log import (
    Airspeed,
    Attitude,
    Choice,
    Findings,
    FlightLog,
    ImportLogError,
    Rates,
)
from uav_ident_ros.import_logs.knowledge import board_to_body, describe_rotation, table
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.px4_actuators import COMMANDS, hovers, read_actuators
from uav_ident_ros.import_logs.px4_folder import read_folder
from uav_ident_ros.import_logs.px4_log import read_ulog, title_of
from uav_ident_ros.import_logs.stamps import Stretches, interpolate, intervals

ARMED = 2
"""vehicle_status.arming_state of an armed vehicle, in old and new logs."""

ROVER = 3
"""vehicle_status.vehicle_type of what drives."""

RELATIVE_STAMP_INVALID = 0x7FFFFFFF
"""sensor_combined: there is no accelerometer sample."""

OTHER_TOPICS = (
    "vehicle_acceleration",
    "vehicle_attitude",
    "vehicle_status",
    "vehicle_land_detected",
    "vehicle_rates_setpoint",
    "vehicle_gps_position",
    "sensor_gps",
    "airspeed_validated",
    "airspeed",
)
"""Topics that are read beside rates and commands."""

RATES_ASKED_FOR = ("roll", "pitch", "yaw")

MOST_GYROS = 4
QUATERNION = 4

IMPORTED = ("CA_", "PWM_", "SENS_BOARD_", "CAL_GYRO", "CAL_ACC", "EKF2_IMU_POS_")
"""First letters of the parameters that an import is based on."""

EXPLAINING = (*IMPORTED, "IMU_", "MC_", "FW_", "SDLOG_", "SYS_AUTOSTART", "MAV_TYPE")
"""... and of those that matter to what comes of it: filters, gains, what is logged."""


def read_px4(
    path: Path,  # ULog file, or a folder that ulog2csv has written
    choice: Choice,  # What to take in place of the best
) -> FlightLog:
    """Read a PX4 log.

    Raises
    ------
    ImportLogError
        If the file cannot be read, or has no rates or no actuators.
    """
    if path.is_dir():
        log = read_folder(path, (*RATES_READERS, *COMMANDS, *OTHER_TOPICS))
    else:
        log = read_ulog(path)
    findings = Findings(lost=list(log.remarks), damage=list(log.damage))
    _refuse_others(log)
    armed = _armed(log)
    flown = _flown(log, armed, findings)
    rates = _read_rates(log, findings, choice, flown or [])
    actuators = read_actuators(log, findings, choice, flown or [])
    lever_arm = read_lever_arm(log.parameters, "EKF2_IMU_POS_", findings)
    airspeed = _airspeed(log, findings)
    say_changes(log, IMPORTED, findings)
    if dropouts := log.dropouts:
        findings.lost.append(
            f"the logger lost messages {len(dropouts)} times, together {sum(dropouts):.3g} s, at "
            f"most {max(dropouts):.3g} s (dropouts)"
        )
    findings.read.append(BOOT_TIME)
    return FlightLog(
        path,
        title_of(log),
        rates,
        actuators,
        findings,
        airspeed,
        lever_arm,
        flown,
        armed,
        _attitude(log, findings),
        read_setpoint(log.messages("vehicle_rates_setpoint"), RATES_ASKED_FOR, 1.0, findings),
        read_mode(log.messages("vehicle_status"), "nav_state", table("px4")["modes"], findings),
        hovers(log, choice.actuators_instance),
        _ground_speed(log, flown or []),
        that_explain(log.parameters, EXPLAINING),
    )


# --- rates --------------------------------------------------------------------------------------


def _refuse_others(log: Log) -> None:
    """Refuse what is no aircraft."""
    for name, known in table("px4")["not_aircraft"].items():
        refuse_others(log, known, log.parameters.get(name), name)
    status = log.messages("vehicle_status")
    if status is not None and "vehicle_type" in status:
        kind = int(status.columns["vehicle_type"][-1])
        refuse_others(log, {ROVER: "a rover"}, kind, "vehicle_status.vehicle_type")


def _read_rates(log: Log, findings: Findings, choice: Choice, flight: Stretches) -> Rates:
    """Read the topic asked for, or the first that is fast enough, or the fastest."""
    usable = find_messages(
        log, "rates", RATES_READERS, choice.rates_topic, choice.rates_instance, log.messages
    )
    streams = {name: (topic.stamp_ns, topic.rate) for name, topic in usable.items()}
    name = choose(streams, flight, findings, "SDLOG_PROFILE")
    rates = RATES_READERS[name](log, usable[name], findings)
    say_instances("sensor_gyro", log.instances("sensor_gyro"), findings)
    return rates


def _from_sensor_combined(log: Log, topic: Messages, findings: Findings) -> Rates:
    """Calibrated mean rates over each gyro period, in the body's axes."""
    findings.read.append(
        "rates: sensor_combined, calibrated means over the gyro's period, before PX4's low-pass, "
        "in body axes forward-right-down"
    )
    _say_orientation(log, findings, "PX4 has turned sensor_combined by it")
    force = topic.vector("accelerometer_m_s2")
    relative = topic.columns["accelerometer_timestamp_relative"]
    valid = relative != RELATIVE_STAMP_INVALID
    if not valid.any():
        findings.lost.append("there is no valid accelerometer sample: ay and az are zero")
        return Rates(topic.name, topic.stamp_ns, topic.vector("gyro_rad"), None)
    if not valid.all():
        findings.lost.append(f"{int((~valid).sum())} accelerometer samples are invalid: held over")
        last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), 0))
        force = force[last]
    offset = float(np.median(relative[valid])) * 1e-3
    if offset:
        findings.read.append(f"accelerometer samples lie {offset:+.2f} ms from the gyro's")
    return Rates(topic.name, topic.stamp_ns, topic.vector("gyro_rad"), force)


def _from_sensor_gyro(log: Log, topic: Messages, findings: Findings) -> Rates:
    """Uncalibrated rates of one gyro, in the board's axes: offset and rotation applied here."""
    raw = topic.values(*"xyz")
    if "timestamp_sample" not in topic:
        findings.assumed.append(
            "sensor_gyro without timestamp_sample (before v1.11) is calibrated, filtered and "
            "turned into body axes by its driver"
        )
        return Rates(topic.name, topic.stamp_ns, raw, _force_at(log, topic, findings))
    matrix = board_to_body(_rotation_number(log), _board_offsets(log))
    if matrix is None:
        raise ImportLogError(
            f"log '{log.path}': SENS_BOARD_ROT is {_rotation_number(log)}, which is not known: "
            "--rates-topic sensor_combined or vehicle_angular_velocity needs no rotation"
        )
    offset = _gyro_offset(log, topic, findings)
    _say_orientation(log, findings, "applied here to sensor_gyro, which is in the board's axes")
    findings.read.append(
        f"rates: {topic.name}, unfiltered, stamped when sampled (timestamp_sample)"
    )
    force = _force_at(log, topic, findings)
    return Rates(topic.name, topic.sample_ns, (raw - offset) @ matrix.T, force)


def _from_angular_velocity(log: Log, topic: Messages, findings: Findings) -> Rates:
    """Take the rates that PX4 controls with."""
    cutoff = log.parameters.get("IMU_GYRO_CUTOFF")
    findings.read.append(
        "rates: vehicle_angular_velocity, in body axes forward-right-down, stamped when sampled"
    )
    findings.lost.append(
        "vehicle_angular_velocity is low-passed"
        + (f" at {cutoff:g} Hz (IMU_GYRO_CUTOFF)" if cutoff else "")
        + " and notched by PX4: it comes late, which counts as a further delay of the inputs"
    )
    return Rates(topic.name, topic.sample_ns, topic.vector("xyz"), _force_at(log, topic, findings))


RATES_READERS: dict[str, Callable[[Log, Messages, Findings], Rates]] = {
    "sensor_combined": _from_sensor_combined,
    "sensor_gyro": _from_sensor_gyro,
    "vehicle_angular_velocity": _from_angular_velocity,
}
"""Readers by topic, the preferred first."""


def _force_at(log: Log, rates: Messages, findings: Findings) -> FloatArray | None:
    """Specific force in body axes at the stamps of the rates, from another topic."""
    for name, field in (("sensor_combined", "accelerometer_m_s2"), ("vehicle_acceleration", "xyz")):
        topic = log.messages(name)
        if topic is not None and topic.rate >= ENOUGH_RATE:
            findings.read.append(f"specific force: {name}, interpolated to the stamps of the rates")
            return interpolate(rates.sample_ns, topic.sample_ns, topic.vector(field))
    findings.lost.append(NO_FORCE)
    return None


def _rotation_number(log: Log) -> int:
    return int(log.parameters.get("SENS_BOARD_ROT", 0))


def _board_offsets(log: Log) -> tuple[float, float, float]:
    x, y, z = (float(log.parameters.get(f"SENS_BOARD_{a}_OFF", 0.0)) for a in "XYZ")
    return x, y, z


def _say_orientation(log: Log, findings: Findings, consequence: str) -> None:
    if "SENS_BOARD_ROT" not in log.parameters:
        findings.assumed.append(f"the log has no SENS_BOARD_ROT: rotation none ({consequence})")
        return
    number = _rotation_number(log)
    offsets = _board_offsets(log)
    fine = ", fine offsets {:.2f} {:.2f} {:.2f} deg".format(*offsets) if any(offsets) else ""
    findings.read.append(
        f"board orientation: SENS_BOARD_ROT {number}, {describe_rotation(number)}{fine}; "
        f"{consequence}"
    )


def _gyro_offset(log: Log, topic: Messages, findings: Findings) -> FloatArray:
    """Calibrated offset of the gyro with this device number, rad/s, board axes."""
    device = int(topic.columns["device_id"][0]) if "device_id" in topic else 0
    for i in range(MOST_GYROS):
        if device and int(log.parameters.get(f"CAL_GYRO{i}_ID", 0)) == device:
            findings.read.append(f"gyro offset: CAL_GYRO{i}_XOFF, YOFF, ZOFF, subtracted")
            return np.array([log.parameters.get(f"CAL_GYRO{i}_{a}OFF", 0.0) for a in "XYZ"])
    findings.assumed.append("no CAL_GYROi_ID is this gyro's: its offset is taken as zero")
    return np.zeros(3)


# --- the rest -----------------------------------------------------------------------------------


def _airspeed(log: Log, findings: Findings) -> Airspeed | None:
    """Find the true airspeed: validated by PX4 (newer logs) or as measured."""
    for name in ("airspeed_validated", "airspeed"):
        topic = log.messages(name)
        if topic is not None and "true_airspeed_m_s" in topic:
            speed = topic.columns["true_airspeed_m_s"].astype(float)
            if np.isfinite(speed).any():
                findings.read.append(f"true airspeed: {name}.true_airspeed_m_s")
                return Airspeed(name, topic.stamp_ns, speed)
    return None


def _attitude(log: Log, findings: Findings) -> Attitude | None:
    """Find PX4's estimate of the attitude."""
    topic = log.messages("vehicle_attitude")
    if topic is None or topic.size("q") != QUATERNION:
        return None
    findings.read.append("attitude: vehicle_attitude.q, as the Imu's orientation (FRD to NED)")
    return Attitude(topic.name, topic.sample_ns, topic.vector("q", QUATERNION)[:, [1, 2, 3, 0]])


def _ground_speed(log: Log, flight: Stretches) -> float:
    """Return the median speed over ground in flight, m/s; 0 if it is not known."""
    for name in ("vehicle_gps_position", "sensor_gps"):
        topic = log.messages(name)
        if topic is not None and "vel_m_s" in topic:
            return median_in_flight(topic.stamp_ns, topic.columns["vel_m_s"].astype(float), flight)
    return 0.0


def _armed(log: Log) -> list[tuple[int, int]] | None:
    """Stretches in which it was armed; None if the log does not say."""
    status = log.messages("vehicle_status")
    if status is None or "arming_state" not in status:
        return None
    armed = status.columns["arming_state"] == ARMED
    return intervals(status.stamp_ns, armed, log.end_ns, log.start_ns)


def _flown(
    log: Log, armed: list[tuple[int, int]] | None, findings: Findings
) -> list[tuple[int, int]] | None:
    """Stretches in the air, else those armed; None if the log says neither."""
    if armed is not None and not armed:
        findings.lost.append(
            "the vehicle was never armed (vehicle_status.arming_state): nothing moved by its "
            "actuators, so no model can come of this log"
        )
        return []
    landed = log.messages("vehicle_land_detected")
    if landed is not None and "landed" in landed:
        stretches = intervals(
            landed.stamp_ns, landed.columns["landed"] == 0, log.end_ns, log.start_ns
        )
        say_stretches("in the air", "vehicle_land_detected", stretches, findings)
        return stretches
    if armed is not None:
        say_stretches("armed", "vehicle_status.arming_state", armed, findings)
        return armed
    findings.assumed.append("the log does not say when it flew: all of it counts as flight")
    return None
