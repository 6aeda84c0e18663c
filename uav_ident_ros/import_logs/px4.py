# SPDX-License-Identifier: Apache-2.0
"""PX4 logs (`.ulg`): rates, commands, airspeed and what the log says of them."""

from pathlib import Path

import numpy as np

from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import Import, RatesReader, table
from uav_ident_ros.import_logs.flight_log import Choice, FlightLog, Stream, rates_stream
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.px4_actuators import COMMANDS, hovers, read_actuators
from uav_ident_ros.import_logs.px4_folder import read_folder
from uav_ident_ros.import_logs.px4_log import read_ulog
from uav_ident_ros.import_logs.stamps import intervals
from uav_ident_ros.messages.types import PX4_ARMING_STATE_ARMED, PX4_RELATIVE_TIMESTAMP_INVALID

LANDED = "vehicle_land_detected"

MOST_GYROS = 4


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
    for name in ("CA_AIRFRAME", "MAV_TYPE"):
        it.refuse_others(name, log.parameters.get(name), name)
    armed, status = None, log.messages("vehicle_status")
    if status is not None and status.has("vehicle_type"):
        kind = int(status.columns["vehicle_type"][-1])
        it.refuse_others("vehicle_type", kind, "vehicle_status.vehicle_type")
    if status is not None and status.has("arming_state"):
        active = status.columns["arming_state"] == PX4_ARMING_STATE_ARMED
        armed = intervals(status.stamp_ns, active, log.end_ns, log.start_ns)
    it.take_flight(
        LANDED, "landed", lambda landed: landed == 0, armed, "vehicle_status.arming_state"
    )
    rates = it.read_rates(RATES_READERS, log.messages, "sensor_gyro")
    hovering = hovers(log, choice.actuators_instance)
    return it.flight_log(rates, read_actuators(it), hovers=hovering)


def _from_sensor_combined(it: Import, topic: Messages) -> Stream:
    """Calibrated mean rates over each gyro period, in the body's axes."""
    _say_orientation(it, "PX4 has turned sensor_combined by it")
    relative = topic.columns["accelerometer_timestamp_relative"]
    valid = relative != PX4_RELATIVE_TIMESTAMP_INVALID
    force = None
    if not valid.any():
        it.findings.doubt("there is no valid accelerometer sample: ay and az are zero")
    else:
        last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), 0))
        force = topic.array("accelerometer_m_s2")[last]
        if not valid.all():
            it.findings.doubt(f"{int((~valid).sum())} accelerometer samples are invalid: held over")
        if offset := float(np.median(relative[valid])) * 1e-3:
            it.findings.say(f"accelerometer samples lie {offset:+.2f} ms from the gyro's")
    return rates_stream(topic.name, topic.stamp_ns, topic.array("gyro_rad"), force)


def _from_sensor_gyro(it: Import, topic: Messages) -> Stream:
    """Uncalibrated rates of one gyro, in the board's axes: offset and rotation applied here."""
    rates = topic.values(*"xyz")
    if not topic.has("timestamp_sample"):
        it.findings.assume(
            "sensor_gyro without timestamp_sample (before v1.11) is calibrated, filtered and "
            "turned into body axes by its driver"
        )
    else:
        number = int(it.log.parameter("SENS_BOARD_ROT"))
        listed = table("rotations").get(number)
        if listed is None:
            raise it.log.refusal(
                f": SENS_BOARD_ROT is {number}, which is not known: "
                "--rates-topic sensor_combined or vehicle_angular_velocity needs no rotation"
            )
        fine = rotation(*np.radians(_board_offsets(it.log)))
        rates = (rates - _gyro_offset(it.log, topic)) @ (fine @ rotation(*np.radians(listed))).T
        _say_orientation(it, "applied here to sensor_gyro, which is in the board's axes")
    return rates_stream(topic.name, topic.sample_ns, rates, it.force_at(topic))


def _from_angular_velocity(it: Import, topic: Messages) -> Stream:
    """Take the rates that PX4 controls with."""
    return rates_stream(topic.name, topic.sample_ns, topic.array("xyz"), it.force_at(topic))


RATES_READERS: dict[str, RatesReader] = {
    "sensor_combined": _from_sensor_combined,
    "sensor_gyro": _from_sensor_gyro,
    "vehicle_angular_velocity": _from_angular_velocity,
}
"""Readers by topic, the preferred first."""


def _board_offsets(log: Log) -> list[float]:
    """Return the fine roll, pitch, yaw of the board, deg."""
    return [log.parameter(f"SENS_BOARD_{axis}_OFF") for axis in "XYZ"]


def _say_orientation(it: Import, consequence: str) -> None:
    offsets = _board_offsets(it.log)
    fine = ", fine offsets {:.2f} {:.2f} {:.2f} deg".format(*offsets) if any(offsets) else ""
    it.say_orientation("SENS_BOARD_ROT", consequence, fine)


def _gyro_offset(log: Log, topic: Messages) -> FloatArray:
    """Calibrated offset of the gyro with this device number, rad/s, board axes."""
    device = int(topic.columns["device_id"][0]) if topic.has("device_id") else 0
    for i in range(MOST_GYROS):
        if device and int(log.parameter(f"CAL_GYRO{i}_ID")) == device:
            log.findings.say(f"gyro offset: CAL_GYRO{i}_XOFF, YOFF, ZOFF, subtracted")
            return np.array([log.parameter(f"CAL_GYRO{i}_{axis}OFF") for axis in "XYZ"])
    log.findings.assume("no CAL_GYROi_ID is this gyro's: its offset is taken as zero")
    return np.zeros(3)
