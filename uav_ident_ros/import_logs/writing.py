# SPDX-License-Identifier: Apache-2.0
"""Output of an import: a bag with the standard topics, and the parameters for it."""

import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.bags.writing import (
    IMU,
    JOINT_STATE,
    TWIST,
    VECTOR,
    BagWriter,
    imu,
    joint_state,
    plain,
    qos,
    twist_stamped,
    vector_stamped,
    whole,
)
from uav_ident_ros.files.parameter_file import PARAMETER_FILE, load_parameters, written
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.import_logs.flight_log import FlightLog, printable
from uav_ident_ros.import_logs.log import LogStream
from uav_ident_ros.import_logs.stamps import Stretches, coverage, inside, turned_at
from uav_ident_ros.messages.types import FRAME_IDS

ARMED_STEP_NS = 1_000_000_000
"""Period of the armed messages between changes, ns: the type has no stamp."""

STRING, BOOL = "std_msgs/msg/String", "std_msgs/msg/Bool"

FIRST_NS = 1
"""First stamp of a bag, ns: in ROS zero means no stamp, and the message would be lost."""

LOG_TOPICS = {
    "actuators": ("/actuators", JOINT_STATE),
    "rates": ("/imu/data", IMU),
    "airspeed": ("/airspeed", TWIST),
    "setpoint": ("/setpoint/rates", VECTOR),
    "mode": ("/mode", STRING),
    "armed": ("/armed", BOOL),
}
"""Topic and type of each stream, in the order of writing at equal times."""


def write_import(flight: FlightLog, values: Mapping[str, Any], folder: Path) -> None:
    """Write the bag, and the parameters for it into its folder.

    Raises
    ------
    BagWriteError
        If it cannot be written; no partial output remains.
    """
    streams = dict(flight.streams)
    rates = streams["rates"]
    if (attitude := streams.get("attitude")) is not None:
        turned = turned_at(rates.t_ns, attitude.t_ns, attitude.values)
        streams["rates"] = replace(rates, values=np.hstack([rates.values, turned]))
    if flight.flown is not None:
        streams["armed"] = _armed(flight.flown, rates.t_ns)
    with whole(folder) as working:
        with BagWriter(working) as bag:
            recorded = [name for name in LOG_TOPICS if name in streams]
            for name in recorded:
                profile = qos(500, reliable=False) if name == "rates" else qos(10)
                bag.topic(*LOG_TOPICS[name], profile)
            bag.merge(_messages(flight, name, streams[name]) for name in recorded)
        _write_parameters(working / PARAMETER_FILE, flight, values)


def _messages(flight: FlightLog, name: str, stream: LogStream) -> Iterator[tuple[int, str, Any]]:
    """Yield log time, topic and message; log times do not decrease, even if stamps do."""
    topic, msgtype = LOG_TOPICS[name]
    channels = [channel.name for channel in flight.channels]
    frame, force = FRAME_IDS[flight.convention], slice(3, 6 if flight.has_force else 3)
    make: Mapping[str, Callable[[int, Any], Any]] = {
        "actuators": lambda t_ns, sample: joint_state(t_ns, channels, sample),
        "rates": lambda t_ns, sample: imu(t_ns, sample[:3], sample[force], frame, sample[6:]),
        "airspeed": lambda t_ns, sample: twist_stamped(t_ns, (sample, 0.0, 0.0)),
        "setpoint": lambda t_ns, sample: vector_stamped(t_ns, sample, FRAME_IDS["frd"]),
        **dict.fromkeys(("mode", "armed"), lambda _, sample: plain(msgtype, sample)),
    }
    stamp_ns = np.maximum(stream.t_ns, FIRST_NS)
    log_ns = np.maximum.accumulate(stamp_ns).tolist()
    for recorded, t_ns, sample in zip(log_ns, stamp_ns.tolist(), stream.values, strict=True):
        yield recorded, topic, make[name](t_ns, sample.tolist())


def _armed(flown: Stretches, rates_ns: TimeArray) -> LogStream:
    """Return the armed state at every change and once a second: the type has no stamp."""
    start, end = int(rates_ns.min()), int(rates_ns.max())
    # Only seconds with rates: a damaged stamp may be years ahead.
    seconds = start + ARMED_STEP_NS * np.unique((rates_ns - start) // ARMED_STEP_NS)
    changes = np.array([t for stretch in flown for t in stretch], dtype=np.int64)
    t_ns = np.union1d(seconds, changes[(start <= changes) & (changes < end)])
    until = [(first, last - 1) for first, last in flown]
    return LogStream("armed", t_ns[t_ns < end], inside(t_ns[t_ns < end], until))


# --- the parameters for it ------------------------------------------------------------------------


WITHOUT_FORCES, WITHOUT_WINGS = "throttle_coupled", "augmented"
"""Structures without an accelerometer, and of a multirotor: its forces do not depend on an angle of
attack. The others have the default."""

SLOWEST_FLIGHT, FASTEST = 5.0, 400.0
"""Least airspeed of a wing, m/s: a lower one is a multirotor's or of a sensor that is off.
And the upper limit of `airspeed.reference`, m/s."""

SLOWEST_NS = 2_500_000_000
"""Time that a sample of the airspeed covers, ns: autopilots log at 1 Hz or more."""

ENOUGH_AIRSPEED = 0.8
"""Least coverage of the flight by a usable airspeed, relative to that by the rates."""

LEARN_TRIM_TIME = 2.0
"""Length of the steady stretch for the estimate of the trim, s."""

DIRECTIONS = ("nose down", "nose left", "right wing down", "throttle")
"""Direction of a positive de, dr, da, dth."""

SIGNS = {"de": "-qdot/de", "dr": "-rdot/dr", "da": "+pdot/da"}
"""Signs of the control derivatives for these directions. If the flight differs, a channel has the
wrong sign in the autopilot's parameters or in the column map."""

COMMENT_WIDTH = 96


def fitting(
    flight: FlightLog,
    trim: str,  # One of `flight_log.TRIMS`
    airspeed: bool | None,  # Whether to scale with the airspeed; None if measured in flight
) -> dict[str, Any]:
    """Return the parameters of the identifier for a log, by dotted name."""
    channels = [channel for _, channel in flight.used]
    values: dict[str, Any] = {
        "imu.type": IMU,
        "imu.convention": flight.convention,
        "imu.lever_arm": list(flight.lever_arm),
        "actuators.type": JOINT_STATE,
        "actuators.channels": [channel.name for channel in channels],
        "actuators.scale": [channel.scale for channel in channels],
        "actuators.trim": _trim(flight, trim),
        "actuators.estimate_delay": True,
    }
    if not flight.has_force:
        values["structure"] = WITHOUT_FORCES
    elif flight.hovers:
        values["structure"] = WITHOUT_WINGS
    if trim == "learn":
        values["actuators.learn_trim_time"] = LEARN_TRIM_TIME
    for i, name in enumerate(INPUTS):
        values[f"actuators.mixing.{name}"] = [channel.effect[i] for channel in channels]
    moved = [name for name in SIGNS if any(values[f"actuators.mixing.{name}"])]
    if moved:
        values["supervision.expected_signs"] = [SIGNS[name] for name in moved]
    if flight.flown is not None:
        values["armed.type"] = BOOL
    return values | _airspeed(flight, airspeed)


def log_summary(flight: FlightLog, values: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the findings about a log and the description of its inputs, by heading."""
    channels = [channel for _, channel in flight.used]
    inputs = []
    for channel, trim in zip(channels, values["actuators.trim"], strict=True):
        scale = f", times {channel.scale:.6g}" if channel.scale != 1.0 else ""
        inputs.append(f"{channel.name}: {channel.meaning}; {channel.unit} less {trim:.6g}{scale}")
    for i, (name, direction) in enumerate(zip(INPUTS, DIRECTIONS, strict=True)):
        terms = [f"{c.effect[i]:+.4g} {c.name}" for c in channels if c.effect[i]]
        inputs.append(f"{name} ({direction}) = {' '.join(terms) or 'nothing'}")
    findings = flight.log.findings
    titled = {
        "Damaged": findings.damage,
        "From the log": findings.read,
        "Assumed": findings.assumed,
        "Missing or doubtful": findings.lost,
        "Inputs": inputs,
    }
    return {title: sentences for title, sentences in titled.items() if sentences}


def _write_parameters(path: Path, flight: FlightLog, values: Mapping[str, Any]) -> None:
    """Write the parameter file, with the findings as comments."""
    log, titled = flight.log, log_summary(flight, values)
    heading = f"What the topics of this bag mean, from '{log.path.name}' ({log.title})."
    if flight.parameters:
        named = ", ".join(f"{name} {value:g}" for name, value in flight.parameters.items())
        titled["Parameters of the autopilot"] = [named]
    lines = ["# SPDX-License-Identifier: Apache-2.0", *_comment(heading)]
    for title, sentences in titled.items():
        lines.append(f"# {title}:")
        lines += [line for sentence in sentences for line in _comment(sentence, "- ", "  ")]
    lines += ["/**:", "  ros__parameters:"]
    lines += [f"    {name}: {written(value)}" for name, value in values.items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    try:
        Settings.from_values(load_parameters(path, "/identifier"))
    except SettingsError as error:
        raise log.refusal(f" gives no usable parameters: {error}") from None


def _trim(flight: FlightLog, trim: str) -> list[float]:
    """Return the raw value of each used channel in trimmed flight."""
    flown = flight.streams["actuators"].values[flight.in_flight("actuators")]
    result = []
    for column, channel in flight.used:
        raw = flown[np.isfinite(flown[:, column]), column]
        usual = float(np.median(raw)) if trim == "flight" and len(raw) else channel.neutral
        result.append(usual if channel.trim is None else channel.trim)
    return result


def _airspeed(flight: FlightLog, use: bool | None) -> dict[str, Any]:
    """Return the parameters of the airspeed: its message, if it is used, and its usual value."""
    findings, ground = flight.log.findings, flight.ground_speed
    if use and "airspeed" not in flight.streams:
        raise flight.log.refusal(" has no airspeed: leave --airspeed out")
    values: dict[str, Any] = {}
    speed = _flown_speed(flight)
    median = f"in flight its median is {speed:.3g} m/s"
    if use if use is not None else speed >= SLOWEST_FLIGHT:
        values["airspeed.type"] = TWIST
        findings.read.append(f"the airspeed is used; {median}")
    elif "airspeed" in flight.streams:
        reason = median if speed else "it was not measured for most of the flight"
        findings.lost.append(f"the airspeed is not used: {reason}")
    if (usual := speed or ground) >= SLOWEST_FLIGHT:
        values["airspeed.reference"] = round(min(usual, FASTEST), 3)
    if speed >= SLOWEST_FLIGHT or flight.hovers:
        return values
    if ground >= SLOWEST_FLIGHT:
        findings.assumed.append(
            f"airspeed.reference is the median speed over ground, {ground:.3g} m/s"
        )
    else:
        findings.lost.append(
            "no speed of flight is in the log: set airspeed.reference to the usual airspeed, at "
            "which the coefficients hold"
        )
    return values


def _flown_speed(flight: FlightLog) -> float:
    """Return the median airspeed in flight, m/s; 0 if it was measured for too little of it."""
    if (airspeed := flight.streams.get("airspeed")) is None:
        return 0.0
    rates = flight.streams["rates"].t_ns
    measured = airspeed.chosen(flight.in_flight("airspeed") & (airspeed.values > 0.0))
    flown = flight.flown or [(int(rates.min()), int(rates.max()))]
    # Relative to the rates: joined recordings, or a paused logger, have gaps in all streams.
    logged = coverage(rates, flown, SLOWEST_NS)
    if coverage(measured.t_ns, flown, SLOWEST_NS) < ENOUGH_AIRSPEED * logged:
        return 0.0
    return float(np.median(measured.values))


def _comment(text: str, first: str = "", other: str = "") -> list[str]:
    return textwrap.wrap(
        printable(text, len(text)),
        COMMENT_WIDTH,
        initial_indent=f"# {first}",
        subsequent_indent=f"# {other}",
        break_on_hyphens=False,
    )
