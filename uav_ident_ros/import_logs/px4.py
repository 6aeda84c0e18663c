# SPDX-License-Identifier: Apache-2.0
"""PX4 logs (`.ulg`): rates, commands, airspeed and what the log says of them."""

from pathlib import Path

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import Import, RatesReader
from uav_ident_ros.import_logs.flight_log import Choice, FlightLog
from uav_ident_ros.import_logs.knowledge import board_to_body, table
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.px4_actuators import COMMANDS, hovers, read_actuators
from uav_ident_ros.import_logs.px4_folder import read_folder
from uav_ident_ros.import_logs.px4_log import read_ulog, title_of
from uav_ident_ros.import_logs.stamps import intervals
from uav_ident_ros.messages.types import PX4_RELATIVE_TIMESTAMP_INVALID

ARMED = 2
"""vehicle_status.arming_state of an armed vehicle, in old and new logs."""

MOST_GYROS = 4

Rates = tuple[TimeArray, FloatArray, FloatArray | None]


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
    known = table("px4")
    if path.is_dir():
        streams = {kind for kinds in known["streams"].values() for kind in kinds}
        log = read_folder(path, {*RATES_READERS, *COMMANDS, *streams, *known["force"], LANDED})
    else:
        log = read_ulog(path)
    it = Import(log, known, choice)
    status = log.messages("vehicle_status")
    for name in ("CA_AIRFRAME", "MAV_TYPE"):
        it.refuse_others(name, log.parameters.get(name), name)
    if status is not None and "vehicle_type" in status:
        kind = int(status.columns["vehicle_type"][-1])
        it.refuse_others("vehicle_type", kind, "vehicle_status.vehicle_type")
    it.in_the_air(log.messages(LANDED), "landed", lambda landed: landed == 0)
    armed = None
    if status is not None and "arming_state" in status:
        active = status.columns["arming_state"] == ARMED
        armed = intervals(status.stamp_ns, active, log.end_ns, log.start_ns)
    it.say_flight(armed, "vehicle_status.arming_state")
    rates = it.read_rates(RATES_READERS, log.messages, "sensor_gyro")
    actuators = read_actuators(it)
    hovering = hovers(log, choice.actuators_instance)
    return it.flight_log(title_of(log), rates, actuators, hovers=hovering)


LANDED = "vehicle_land_detected"


# --- rates --------------------------------------------------------------------------------------


def _from_sensor_combined(it: Import, topic: Messages) -> Rates:
    """Calibrated mean rates over each gyro period, in the body's axes."""
    findings = it.log.findings
    _say_orientation(it, "PX4 has turned sensor_combined by it")
    relative = topic.columns["accelerometer_timestamp_relative"]
    valid = relative != PX4_RELATIVE_TIMESTAMP_INVALID
    if not valid.any():
        findings.doubt("there is no valid accelerometer sample: ay and az are zero")
        return topic.stamp_ns, topic.array("gyro_rad"), None
    if not valid.all():
        findings.doubt(f"{int((~valid).sum())} accelerometer samples are invalid: held over")
    last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), 0))
    if offset := float(np.median(relative[valid])) * 1e-3:
        findings.say(f"accelerometer samples lie {offset:+.2f} ms from the gyro's")
    return topic.stamp_ns, topic.array("gyro_rad"), topic.array("accelerometer_m_s2")[last]


def _from_sensor_gyro(it: Import, topic: Messages) -> Rates:
    """Uncalibrated rates of one gyro, in the board's axes: offset and rotation applied here."""
    log, raw = it.log, topic.values(*"xyz")
    if "timestamp_sample" not in topic:
        log.findings.assume(
            "sensor_gyro without timestamp_sample (before v1.11) is calibrated, filtered and "
            "turned into body axes by its driver"
        )
        return topic.stamp_ns, raw, it.force_at(topic, it.table["force"])
    matrix = board_to_body(_rotation_number(log), _board_offsets(log))
    if matrix is None:
        raise log.refusal(
            f": SENS_BOARD_ROT is {_rotation_number(log)}, which is not known: "
            "--rates-topic sensor_combined or vehicle_angular_velocity needs no rotation"
        )
    offset = _gyro_offset(log, topic)
    _say_orientation(it, "applied here to sensor_gyro, which is in the board's axes")
    return topic.sample_ns, (raw - offset) @ matrix.T, it.force_at(topic, it.table["force"])


def _from_angular_velocity(it: Import, topic: Messages) -> Rates:
    """Take the rates that PX4 controls with."""
    return topic.sample_ns, topic.array("xyz"), it.force_at(topic, it.table["force"])


RATES_READERS: dict[str, RatesReader] = {
    "sensor_combined": _from_sensor_combined,
    "sensor_gyro": _from_sensor_gyro,
    "vehicle_angular_velocity": _from_angular_velocity,
}
"""Readers by topic, the preferred first."""


def _rotation_number(log: Log) -> int:
    return int(log.parameter("SENS_BOARD_ROT"))


def _board_offsets(log: Log) -> tuple[float, float, float]:
    x, y, z = (log.parameter(f"SENS_BOARD_{axis}_OFF") for axis in "XYZ")
    return x, y, z


def _say_orientation(it: Import, consequence: str) -> None:
    offsets = _board_offsets(it.log)
    fine = ", fine offsets {:.2f} {:.2f} {:.2f} deg".format(*offsets) if any(offsets) else ""
    it.say_orientation("SENS_BOARD_ROT", consequence, fine)


def _gyro_offset(log: Log, topic: Messages) -> FloatArray:
    """Calibrated offset of the gyro with this device number, rad/s, board axes."""
    device = int(topic.columns["device_id"][0]) if "device_id" in topic else 0
    for i in range(MOST_GYROS):
        if device and int(log.parameter(f"CAL_GYRO{i}_ID")) == device:
            log.findings.say(f"gyro offset: CAL_GYRO{i}_XOFF, YOFF, ZOFF, subtracted")
            return np.array([log.parameter(f"CAL_GYRO{i}_{axis}OFF") for axis in "XYZ"])
    log.findings.assume("no CAL_GYROi_ID is this gyro's: its offset is taken as zero")
    return np.zeros(3)
