# SPDX-License-Identifier: Apache-2.0
"""An imported log as a bag with the standard topics, and the parameters that fit it beside it."""

from __future__ import annotations

import heapq
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.bags.writing import BagWriteError, BagWriter, header, message_class, qos
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.files.parameter_template import written
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.import_logs.flight_log import (
    Channel,
    Findings,
    FlightLog,
    Mode,
    Setpoint,
    printable,
)
from uav_ident_ros.import_logs.knowledge import at_times
from uav_ident_ros.import_logs.stamps import coverage

IMU_TOPIC, IMU_TYPE = "/imu/data", "sensor_msgs/msg/Imu"
ACTUATORS_TOPIC, ACTUATORS_TYPE = "/actuators", "sensor_msgs/msg/JointState"
AIRSPEED_TOPIC, AIRSPEED_TYPE = "/airspeed", "geometry_msgs/msg/TwistStamped"
ARMED_TOPIC, ARMED_TYPE = "/armed", "std_msgs/msg/Bool"
SETPOINT_TOPIC, SETPOINT_TYPE = "/setpoint/rates", "geometry_msgs/msg/Vector3Stamped"
MODE_TOPIC, MODE_TYPE = "/mode", "std_msgs/msg/String"

WITHOUT_FORCES, WITHOUT_WINGS = "throttle_coupled", "augmented"
"""Structure if there is no accelerometer, and that of a multirotor: no angle of attack tells its
forces. The others have the default."""

ARMED_STEP_NS = 1_000_000_000
"""Time between two messages that say the same of whether it is armed, ns: the type has no stamp."""

SLOWEST_FLIGHT = 5.0
"""Airspeed, m/s, below which forces do not go with it: a multirotor's, or a sensor that is off."""

FASTEST = 400.0
"""What `airspeed.reference` may be at most, m/s."""

SLOWEST_NS = 2_500_000_000
"""For how long a sample of the airspeed counts, ns: the autopilots log one a second or more."""

ENOUGH_AIRSPEED = 0.8
"""Share of the flight that an airspeed must cover to be used."""

FRAME_IDS = {"frd": "base_link_frd", "flu": "base_link"}
"""Frame of the Imu's header; the identifier takes the suffix as the convention."""

PARAMETER_FILE = "identifier.yaml"

NOT_MEASURED = np.array([-1.0, *[0.0] * 8])
"""Covariance that says that there is no such measurement (sensor_msgs/Imu)."""

UNKNOWN = np.zeros(9)
"""Covariance that is not known (sensor_msgs/Imu)."""

LEARN_TRIM_TIME = 2.0
"""Length of the steady stretch that the trim is learnt from, s."""

DIRECTIONS = ("nose down", "nose left", "right wing down", "throttle")
"""What a positive de, dr, da, dth does."""

COMMENT_WIDTH = 96

Entry = tuple[int, str, Any]


def write_import(
    log: FlightLog,  # The log
    folder: Path,  # Folder of the new bag; must not exist
    parameters: dict[str, Any],  # What `fitting_parameters` gives for it
) -> Path:
    """Write the bag and the parameter file.

    Returns
    -------
    Path
        The parameter file.

    Raises
    ------
    BagWriteError
        If the folder exists or cannot be written; nothing half-written stays behind.
    """
    existed = folder.exists()
    try:
        return _write(log, folder, parameters)
    except BaseException as error:
        if not existed:
            shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, OSError):
            raise BagWriteError(f"cannot write to '{folder}': {error.strerror}") from None
        raise


def _write(log: FlightLog, folder: Path, parameters: dict[str, Any]) -> Path:
    with BagWriter(folder) as bag:
        bag.topic(IMU_TOPIC, IMU_TYPE, qos(500, reliable=False))
        bag.topic(ACTUATORS_TOPIC, ACTUATORS_TYPE, qos(10))
        streams = [_actuator_entries(log), _imu_entries(log)]
        if log.airspeed is not None:
            bag.topic(AIRSPEED_TOPIC, AIRSPEED_TYPE, qos(10))
            streams.append(_airspeed_entries(log))
        if log.armed is not None:
            bag.topic(ARMED_TOPIC, ARMED_TYPE, qos(10))
            streams.append(_armed_entries(log))
        if log.setpoint is not None:
            bag.topic(SETPOINT_TOPIC, SETPOINT_TYPE, qos(10))
            streams.append(_setpoint_entries(log.setpoint))
        if log.mode is not None:
            bag.topic(MODE_TOPIC, MODE_TYPE, qos(10))
            streams.append(_mode_entries(log.mode))
        # At equal times the actuators come first, as the command precedes its effect.
        for log_ns, topic, message in heapq.merge(*streams, key=lambda entry: entry[0]):
            bag.write(topic, log_ns, message)
    path = folder / PARAMETER_FILE
    path.write_text(_parameter_text(log, parameters), encoding="utf-8")
    Settings.from_values(load_parameters(path, "/identifier"))  # what was written can be used
    return path


# --- bag ----------------------------------------------------------------------------------------


def _log_times(t_ns: TimeArray) -> list[int]:
    """Log times that never step back, as a recorder's, whatever the stamps do."""
    return [int(t) for t in np.maximum.accumulate(t_ns)]


def _imu_entries(log: FlightLog) -> Iterator[Entry]:
    imu, vector = message_class(IMU_TYPE), message_class("geometry_msgs/msg/Vector3")
    quaternion = message_class("geometry_msgs/msg/Quaternion")
    rates = log.rates
    frame_id = FRAME_IDS[rates.convention]
    force = np.zeros_like(rates.rates) if rates.force is None else rates.force
    turned = [(0.0, 0.0, 0.0, 1.0)] * len(force)
    if log.attitude is not None:
        turned = at_times(rates.t_ns, log.attitude.t_ns, log.attitude.quaternion).tolist()
    columns = (
        _log_times(rates.t_ns),
        rates.t_ns.tolist(),
        rates.rates.tolist(),
        force.tolist(),
        turned,
    )
    for log_ns, t_ns, pqr, f, xyzw in zip(*columns, strict=True):
        yield (
            log_ns,
            IMU_TOPIC,
            imu(
                header=header(t_ns, frame_id),
                orientation=quaternion(*xyzw),
                orientation_covariance=NOT_MEASURED if log.attitude is None else UNKNOWN,
                angular_velocity=vector(*pqr),
                angular_velocity_covariance=UNKNOWN,
                linear_acceleration=vector(*f),
                linear_acceleration_covariance=NOT_MEASURED if rates.force is None else UNKNOWN,
            ),
        )


def _actuator_entries(log: FlightLog) -> Iterator[Entry]:
    joint_state = message_class(ACTUATORS_TYPE)
    actuators = log.actuators
    names = [channel.name for channel in actuators.channels]
    empty = np.zeros(0)
    columns = (_log_times(actuators.t_ns), actuators.t_ns.tolist(), actuators.values)
    for log_ns, t_ns, values in zip(*columns, strict=True):
        position = np.ascontiguousarray(values, dtype=float)
        message = joint_state(
            header=header(t_ns), name=names, position=position, velocity=empty, effort=empty
        )
        yield log_ns, ACTUATORS_TOPIC, message


def _airspeed_entries(log: FlightLog) -> Iterator[Entry]:
    vector, twist = (message_class(f"geometry_msgs/msg/{name}") for name in ("Vector3", "Twist"))
    stamped = message_class(AIRSPEED_TYPE)
    still = vector(x=0.0, y=0.0, z=0.0)
    airspeed = log.airspeed
    assert airspeed is not None  # the caller has looked
    columns = (_log_times(airspeed.t_ns), airspeed.t_ns.tolist(), airspeed.values.tolist())
    for log_ns, t_ns, speed in zip(*columns, strict=True):
        motion = twist(linear=vector(x=speed, y=0.0, z=0.0), angular=still)
        yield log_ns, AIRSPEED_TOPIC, stamped(header=header(t_ns), twist=motion)


def _armed_entries(log: FlightLog) -> Iterator[Entry]:
    """Yield the state at every change, and once a second: the type has no stamp."""
    boolean = message_class(ARMED_TYPE)
    changes = [t for stretch in log.armed or [] for t in stretch]
    start, end = int(log.rates.t_ns.min()), int(log.rates.t_ns.max())
    # Seconds in which there are rates: a damaged stamp may lie years ahead.
    seconds = np.unique((log.rates.t_ns - start) // ARMED_STEP_NS)
    regular = (start + ARMED_STEP_NS * seconds).tolist()
    for t_ns in sorted({*regular, *(t for t in changes if start <= t < end)}):
        armed = any(first <= t_ns < last for first, last in log.armed or [])
        yield t_ns, ARMED_TOPIC, boolean(data=armed)


def _setpoint_entries(setpoint: Setpoint) -> Iterator[Entry]:
    vector, stamped = message_class("geometry_msgs/msg/Vector3"), message_class(SETPOINT_TYPE)
    columns = (_log_times(setpoint.t_ns), setpoint.t_ns.tolist(), setpoint.rates.tolist())
    for log_ns, t_ns, pqr in zip(*columns, strict=True):
        asked = stamped(header=header(t_ns, FRAME_IDS["frd"]), vector=vector(*pqr))
        yield log_ns, SETPOINT_TOPIC, asked


def _mode_entries(mode: Mode) -> Iterator[Entry]:
    string = message_class(MODE_TYPE)
    for log_ns, name in zip(_log_times(mode.t_ns), mode.names.tolist(), strict=True):
        yield log_ns, MODE_TOPIC, string(data=name)


# --- parameters ---------------------------------------------------------------------------------


def inputs_in_words(log: FlightLog, parameters: dict[str, Any]) -> list[str]:
    """Say what each used channel is and how the inputs come about from them."""
    channels = [channel for _, channel in used_channels(log)]
    lines = []
    for channel, trim in zip(channels, parameters["actuators.trim"], strict=True):
        scale = f", times {channel.scale:.6g}" if channel.scale != 1.0 else ""
        lines.append(f"{channel.name}: {channel.meaning}; {channel.unit} less {trim:.6g}{scale}")
    for i, (name, direction) in enumerate(zip(INPUTS, DIRECTIONS, strict=True)):
        terms = [f"{c.effect[i]:+.4g} {c.name}" for c in channels if c.effect[i]]
        lines.append(f"{name} ({direction}) = {' '.join(terms) or 'nothing'}")
    return lines


def used_channels(log: FlightLog) -> list[tuple[int, Channel]]:
    """Column and channel of everything that moves the aircraft."""
    return [(i, c) for i, c in enumerate(log.actuators.channels) if any(c.effect)]


def fitting_parameters(
    log: FlightLog,  # The log
    trim: str,  # One of `flight_log.TRIMS`
    use_airspeed: bool,  # Switch the scaling with the airspeed on
) -> dict[str, Any]:
    """Return parameters of the identifier that fit the bag, by dotted name."""
    channels = [channel for _, channel in used_channels(log)]
    values: dict[str, Any] = {
        "imu.type": IMU_TYPE,
        "imu.convention": log.rates.convention,
        "imu.lever_arm": list(log.lever_arm),
        "actuators.type": ACTUATORS_TYPE,
        "actuators.channels": [channel.name for channel in channels],
        "actuators.scale": [channel.scale for channel in channels],
        "actuators.trim": trim_values(log, trim),
        "actuators.estimate_delay": True,
    }
    if log.rates.force is None:
        values["structure"] = WITHOUT_FORCES
    elif log.hovers:
        values["structure"] = WITHOUT_WINGS
    if trim == "learn":
        values["actuators.learn_trim_time"] = LEARN_TRIM_TIME
    for i, name in enumerate(INPUTS):
        values[f"actuators.mixing.{name}"] = [channel.effect[i] for channel in channels]
    if use_airspeed:
        values["airspeed.type"] = AIRSPEED_TYPE
    if speed := reference_speed(log):
        values["airspeed.reference"] = speed
    if log.armed is not None:
        values["armed.type"] = ARMED_TYPE
    return values


def trim_values(log: FlightLog, trim: str) -> list[float]:
    """Raw value of each used channel in trimmed flight."""
    inside = log.in_flight(log.actuators.t_ns)
    result = []
    for column, channel in used_channels(log):
        raw = log.actuators.values[inside, column]
        raw = raw[np.isfinite(raw)]
        if channel.trim is not None:
            result.append(channel.trim)
        elif trim == "flight" and len(raw):
            result.append(float(np.median(raw)))
        else:
            result.append(channel.neutral)
    return result


def flown_speed(log: FlightLog) -> float:
    """Return the median airspeed in flight, m/s; 0 if it was not measured for most of it."""
    airspeed = log.airspeed
    if airspeed is None:
        return 0.0
    known = np.isfinite(airspeed.values) & (airspeed.values > 0.0)
    flight = log.flown or [(int(log.rates.t_ns.min()), int(log.rates.t_ns.max()))]
    inside = known & log.in_flight(airspeed.t_ns)
    if not inside.any() or coverage(airspeed.t_ns[inside], flight, SLOWEST_NS) < ENOUGH_AIRSPEED:
        return 0.0
    return float(np.median(airspeed.values[inside]))


def reference_speed(log: FlightLog) -> float:
    """Return the usual speed, at which the coefficients are valid, m/s; 0 for a hovering one."""
    speed = flown_speed(log) or log.ground_speed
    return round(min(speed, FASTEST), 3) if speed >= SLOWEST_FLIGHT else 0.0


def _parameter_text(log: FlightLog, parameters: dict[str, Any]) -> str:
    """Return the parameter file, with everything that was found out as comments."""
    lines = [
        "# SPDX-License-Identifier: Apache-2.0",
        *_comment(f"What the topics of this bag mean, from '{log.path.name}' ({log.title})."),
    ]
    inputs = [("Inputs", inputs_in_words(log, parameters))]
    if log.parameters:
        named = ", ".join(f"{name} {value:g}" for name, value in log.parameters.items())
        inputs.append(("Parameters of the autopilot", [named]))
    for title, sentences in findings_by_title(log.findings) + inputs:
        lines.append(f"# {title}:")
        for sentence in sentences:
            lines += _comment(sentence, "- ", "  ")
    lines += ["/**:", "  ros__parameters:"]
    lines += [f"    {name}: {written(value)}" for name, value in parameters.items()]
    return "\n".join(lines) + "\n"


def findings_by_title(findings: Findings) -> list[tuple[str, list[str]]]:
    """Return the findings under their headings, those that are empty left out."""
    titled = [
        ("Damaged", findings.damage),
        ("From the log", findings.read),
        ("Assumed", findings.assumed),
        ("Missing or doubtful", findings.lost),
    ]
    return [(title, sentences) for title, sentences in titled if sentences]


def _comment(text: str, first: str = "", other: str = "") -> list[str]:
    return textwrap.wrap(
        printable(text, len(text)),
        COMMENT_WIDTH,
        initial_indent=f"# {first}",
        subsequent_indent=f"# {other}",
        break_on_hyphens=False,
    )
