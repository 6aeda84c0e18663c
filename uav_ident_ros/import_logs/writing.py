# SPDX-License-Identifier: Apache-2.0
"""An imported log as a bag with the standard topics, and the parameters that fit it."""

import textwrap
from collections.abc import Iterator, Mapping
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
from uav_ident_ros.files.parameter_file import load_parameters, written
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.import_logs.flight_log import FlightLog, ImportLogError, Stream, printable
from uav_ident_ros.import_logs.stamps import Stretches, coverage, inside, turned_at
from uav_ident_ros.messages.types import FRAME_IDS

PARAMETER_FILE = "identifier.yaml"

ARMED_STEP_NS = 1_000_000_000
"""Time between two messages that say the same of whether it is armed, ns: the type has no stamp."""

STRING, BOOL = "std_msgs/msg/String", "std_msgs/msg/Bool"

FIRST_NS = 1
"""First stamp of a bag, ns: zero says in ROS that there is none, and the message would be lost."""


TOPICS = {
    "actuators": ("/actuators", JOINT_STATE),
    "rates": ("/imu/data", IMU),
    "airspeed": ("/airspeed", TWIST),
    "setpoint": ("/setpoint/rates", VECTOR),
    "mode": ("/mode", STRING),
    "armed": ("/armed", BOOL),
}
"""Topic and type of each stream; at equal times they are written in this order."""


def write_import(log: FlightLog, values: Mapping[str, Any], folder: Path) -> None:
    """Write the bag, and into its folder the parameters that fit it.

    Raises
    ------
    BagWriteError
        If it cannot be written; nothing half-written stays behind.
    """
    streams = dict(log.streams)
    rates = streams["rates"]
    if (attitude := streams.get("attitude")) is not None:
        turned = turned_at(rates.t_ns, attitude.t_ns, attitude.values)
        streams["rates"] = replace(rates, values=np.hstack([rates.values, turned]))
    if log.flown is not None:
        streams["armed"] = _armed(log.flown, rates.t_ns)
    with whole(folder) as working:
        with BagWriter(working) as bag:
            recorded = [name for name in TOPICS if name in streams]
            for name in recorded:
                profile = qos(500, reliable=False) if name == "rates" else qos(10)
                bag.topic(*TOPICS[name], profile)
            bag.merge(_messages(log, name, streams[name]) for name in recorded)
        _write_parameters(working / PARAMETER_FILE, log, values)


def _messages(log: FlightLog, name: str, stream: Stream) -> Iterator[tuple[int, str, Any]]:
    """Yield log time, topic and message; log times never step back, whatever the stamps do."""
    stamp_ns = np.maximum(stream.t_ns, FIRST_NS)
    log_ns = np.maximum.accumulate(stamp_ns).tolist()
    for recorded, t_ns, sample in zip(log_ns, stamp_ns.tolist(), stream.values, strict=True):
        yield recorded, TOPICS[name][0], _message(log, name, t_ns, sample)


def _message(log: FlightLog, name: str, t_ns: int, sample: Any) -> Any:
    """Return the message of a sample of a stream."""
    match name:
        case "actuators":
            return joint_state(t_ns, [channel.name for channel in log.channels], sample)
        case "rates":
            rates, force, turned = sample[:3].tolist(), sample[3:6].tolist(), sample[6:].tolist()
            frame = FRAME_IDS[log.convention]
            return imu(t_ns, rates, force if log.has_force else None, frame, turned)
        case "airspeed":
            return twist_stamped(t_ns, (sample.item(), 0.0, 0.0))
        case "setpoint":
            return vector_stamped(t_ns, sample.tolist(), FRAME_IDS["frd"])
        case _:
            return plain(TOPICS[name][1], sample.item())


def _armed(flown: Stretches, rates_ns: TimeArray) -> Stream:
    """Return the state at every change, and once a second: the type has no stamp."""
    start, end = int(rates_ns.min()), int(rates_ns.max())
    # Seconds in which there are rates: a damaged stamp may lie years ahead.
    seconds = start + ARMED_STEP_NS * np.unique((rates_ns - start) // ARMED_STEP_NS)
    changes = np.array([t for stretch in flown for t in stretch], dtype=np.int64)
    t_ns = np.union1d(seconds, changes[(start <= changes) & (changes < end)])
    until = [(first, last - 1) for first, last in flown]
    return Stream("armed", t_ns[t_ns < end], inside(t_ns[t_ns < end], until))


# --- the parameters that fit it -------------------------------------------------------------------


WITHOUT_FORCES, WITHOUT_WINGS = "throttle_coupled", "augmented"
"""Structure if there is no accelerometer, and that of a multirotor: no angle of attack tells its
forces. The others have the default."""

SLOWEST_FLIGHT, FASTEST = 5.0, 400.0
"""Airspeed, m/s, below which forces do not go with it: a multirotor's, or a sensor that is off.
And what `airspeed.reference` may be at most."""

SLOWEST_NS = 2_500_000_000
"""For how long a sample of the airspeed counts, ns: the autopilots log one a second or more."""

ENOUGH_AIRSPEED = 0.8
"""Share of the flight that an airspeed must cover to be used, of what the rates cover of it."""

LEARN_TRIM_TIME = 2.0
"""Length of the steady stretch that the trim is learnt from, s."""

DIRECTIONS = ("nose down", "nose left", "right wing down", "throttle")
"""What a positive de, dr, da, dth does."""

SIGNS = {"de": "-qdot/de", "dr": "-rdot/dr", "da": "+pdot/da"}
"""What these directions make of the control derivatives: a channel that does the opposite has the
wrong sign in the log's parameters or in the column map."""

COMMENT_WIDTH = 96


def fitting(
    log: FlightLog,
    trim: str,  # One of `flight_log.TRIMS`
    airspeed: bool | None,  # Whether to scale with the airspeed; None if measured in flight
) -> dict[str, Any]:
    """Return the parameters of the identifier that fit a log, by dotted name."""
    channels = [channel for _, channel in log.used]
    values: dict[str, Any] = {
        "imu.type": IMU,
        "imu.convention": log.convention,
        "imu.lever_arm": list(log.lever_arm),
        "actuators.type": JOINT_STATE,
        "actuators.channels": [channel.name for channel in channels],
        "actuators.scale": [channel.scale for channel in channels],
        "actuators.trim": _trim(log, trim),
        "actuators.estimate_delay": True,
    }
    if not log.has_force:
        values["structure"] = WITHOUT_FORCES
    elif log.hovers:
        values["structure"] = WITHOUT_WINGS
    if trim == "learn":
        values["actuators.learn_trim_time"] = LEARN_TRIM_TIME
    for i, name in enumerate(INPUTS):
        values[f"actuators.mixing.{name}"] = [channel.effect[i] for channel in channels]
    moved = [name for name in SIGNS if any(values[f"actuators.mixing.{name}"])]
    if moved:
        values["supervision.expected_signs"] = [SIGNS[name] for name in moved]
    if log.flown is not None:
        values["armed.type"] = BOOL
    return values | _airspeed(log, airspeed)


def in_words(log: FlightLog, values: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return all there is to say of a log and the fitting parameters, under headings."""
    channels = [channel for _, channel in log.used]
    inputs = []
    for channel, trim in zip(channels, values["actuators.trim"], strict=True):
        scale = f", times {channel.scale:.6g}" if channel.scale != 1.0 else ""
        inputs.append(f"{channel.name}: {channel.meaning}; {channel.unit} less {trim:.6g}{scale}")
    for i, (name, direction) in enumerate(zip(INPUTS, DIRECTIONS, strict=True)):
        terms = [f"{c.effect[i]:+.4g} {c.name}" for c in channels if c.effect[i]]
        inputs.append(f"{name} ({direction}) = {' '.join(terms) or 'nothing'}")
    titled = {
        "Damaged": log.findings.damage,
        "From the log": log.findings.read,
        "Assumed": log.findings.assumed,
        "Missing or doubtful": log.findings.lost,
        "Inputs": inputs,
    }
    return {title: sentences for title, sentences in titled.items() if sentences}


def _write_parameters(path: Path, log: FlightLog, values: Mapping[str, Any]) -> None:
    """Write the parameter file, with everything that was found out as comments."""
    titled = in_words(log, values)
    heading = f"What the topics of this bag mean, from '{log.path.name}' ({log.title})."
    if log.parameters:
        named = ", ".join(f"{name} {value:g}" for name, value in log.parameters.items())
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
        raise ImportLogError(f"log '{log.path}' gives no usable parameters: {error}") from None


def _trim(log: FlightLog, trim: str) -> list[float]:
    """Raw value of each used channel in trimmed flight."""
    flown = log.streams["actuators"].values[log.in_flight("actuators")]
    result = []
    for column, channel in log.used:
        raw = flown[np.isfinite(flown[:, column]), column]
        usual = float(np.median(raw)) if trim == "flight" and len(raw) else channel.neutral
        result.append(usual if channel.trim is None else channel.trim)
    return result


def _airspeed(log: FlightLog, use: bool | None) -> dict[str, Any]:
    if use and "airspeed" not in log.streams:
        raise ImportLogError(f"log '{log.path}' has no airspeed: leave --airspeed out")
    values: dict[str, Any] = {}
    speed = _flown_speed(log)
    if use if use is not None else speed >= SLOWEST_FLIGHT:
        values["airspeed.type"] = TWIST
        log.findings.read.append(f"the airspeed is used; in flight its median is {speed:.3g} m/s")
    elif "airspeed" in log.streams:
        reason = (
            f"in flight its median is {speed:.3g} m/s"
            if speed
            else "it was not measured for most of the flight"
        )
        log.findings.lost.append(f"the airspeed is not used: {reason}")
    usual = speed or log.ground_speed
    if usual >= SLOWEST_FLIGHT:
        values["airspeed.reference"] = round(min(usual, FASTEST), 3)
    if speed >= SLOWEST_FLIGHT or log.hovers:
        return values
    if log.ground_speed >= SLOWEST_FLIGHT:
        log.findings.assumed.append(
            f"airspeed.reference is the median speed over ground, {log.ground_speed:.3g} m/s"
        )
    else:
        log.findings.lost.append(
            "no speed of flight is in the log: set airspeed.reference to the usual airspeed, which "
            "the forces on wings go with"
        )
    return values


def _flown_speed(log: FlightLog) -> float:
    """Return the median airspeed in flight, m/s; 0 if it was not measured for most of it."""
    if (airspeed := log.streams.get("airspeed")) is None:
        return 0.0
    rates = log.streams["rates"].t_ns
    flown = airspeed.chosen(log.in_flight("airspeed") & (airspeed.values > 0.0))
    flight = log.flown or [(int(rates.min()), int(rates.max()))]
    # Of what was logged: a table of several recordings, or a logger that paused, has gaps in all.
    logged = coverage(rates, flight, SLOWEST_NS)
    if coverage(flown.t_ns, flight, SLOWEST_NS) < ENOUGH_AIRSPEED * logged:
        return 0.0
    return float(np.median(flown.values))


def _comment(text: str, first: str = "", other: str = "") -> list[str]:
    return textwrap.wrap(
        printable(text, len(text)),
        COMMENT_WIDTH,
        initial_indent=f"# {first}",
        subsequent_indent=f"# {other}",
        break_on_hyphens=False,
    )
