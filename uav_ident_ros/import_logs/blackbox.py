# SPDX-License-Identifier: Apache-2.0
"""Blackbox logs of Betaflight and its kin (`.bbl`, `.bfl`), read by orangebox: multirotors."""

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import table
from uav_ident_ros.import_logs.channels import effects_of_arms, over_range
from uav_ident_ros.import_logs.flight_log import (
    Channel,
    Choice,
    FlightLog,
    ImportLogError,
    Stream,
    rates_stream,
)
from uav_ident_ros.import_logs.log import IN_NS, Log, Messages
from uav_ident_ros.messages.types import NS_PER_US

MAGIC = b"H Product:Blackbox flight data recorder"
"""First bytes of every blackbox log."""

GYROS = ("gyroUnfilt", "gyroADC")
"""Fields of the rates, the preferred first: as sampled, and behind the filters."""

SIGNALS = ("gyro", "acc", "motor")
"""First letters of the fields that are measured or commanded."""

WRAP = 2.0**32
"""Range of the numbers that Betaflight computes with."""

FRAMES = "the frames"


def read_blackbox(path: Path, choice: Choice) -> FlightLog:
    """Read the longest log of a file.

    Raises
    ------
    ImportLogError
        If orangebox is missing, or the file cannot be read, or lacks rates or known motors.
    """
    if choice != Choice():
        raise ImportLogError(f"log '{path}': a blackbox has one set of rates and one of motors")
    log = Log(path)
    headers, frames = _read(log)
    name = next((gyro for gyro in GYROS if frames.has(f"{gyro}[2]")), None)
    if name is None:
        fields = ", ".join([*frames.columns][1:])
        raise log.refusal(f" has no rates (gyroADC); it has {fields}")
    bits = headers.get("gyro_scale", "0x3f800000")  # a float's, in hexadecimal digits
    number = int(bits, 16) if isinstance(bits, str) else int(bits)
    scale = float(np.uint32(number).view(np.float32)) * math.pi / 180.0
    force = _specific_force(log, headers, frames)
    log.findings.note(f"rates: {name}, in body axes forward-left-up")
    if name == GYROS[1]:
        cutoff = headers.get("gyro_lowpass_hz", headers.get("gyro_lpf1_static_hz"))
        log.findings.doubt(
            "gyroADC is behind the filters"
            + (f" (low-pass at {cutoff} Hz)" if cutoff else "")
            + ": it comes late, which counts as a further delay of the inputs. Betaflight 4.5 logs "
            "gyroUnfilt, too"
        )
    commands = frames.array("motor") if frames.has("motor[0]") else np.zeros((0, 0))
    channels = _motors(log, headers, commands.shape[1])
    log.findings.assume("all of the log counts as flight: a blackbox begins when it is armed")
    streams = {
        "rates": rates_stream(name, frames.stamp_ns, frames.array(name) * scale, force),
        "actuators": Stream("motor", frames.stamp_ns, commands),
    }
    title = str(headers.get("Firmware revision", headers.get("Firmware type", "blackbox")))
    return FlightLog(path, title, streams, channels, log.findings, convention="flu", hovers=True)


def _specific_force(log: Log, headers: dict[str, Any], frames: Messages) -> FloatArray | None:
    """Return what the accelerometer measured, m/s^2; None where it was off or is not logged."""
    one_g = float(headers.get("acc_1G", 0))
    if frames.has("accSmooth[2]") and one_g > 0.0:
        counts = frames.array("accSmooth")
        if np.any(counts):
            return counts * GRAVITY / one_g
    reason = "is off (acc_1G 0, or zero throughout)" if frames.has("accSmooth[2]") else "is missing"
    log.findings.doubt(f"the accelerometer (accSmooth) {reason}: the model has no forces")
    return None


def _read(log: Log) -> tuple[dict[str, Any], Messages]:
    """Return the headers and the frames of the longest log of a file."""
    try:
        from orangebox import Parser
    except ImportError:
        raise log.lacks("orangebox", "blackbox logs", "blackbox", "orangebox<0.5") from None
    logging.getLogger("orangebox").addHandler(logging.NullHandler())  # it is wordy on stderr
    parser = Parser.load(str(log.path), allow_invalid_header=True)
    starts = [*parser.reader.log_pointers, log.path.stat().st_size]
    longest = int(np.argmax(np.diff(starts))) + 1
    parser.set_log_index(longest)
    if len(starts) > 2:
        log.findings.note(f"log {longest} of {len(starts) - 1} in this file, the longest")
    frames: list[tuple[float, ...]] = []
    try:
        for frame in parser.frames():
            frames.append(frame.data)
    except Exception as error:  # damaged bytes make a parser fail in many ways
        reader = parser.reader
        if reader.tell() >= len(reader):
            log.findings.doubt("the file is cut off at its end: what is there was read")
        else:
            log.findings.damage.append(
                f"the file is damaged: orangebox stopped at byte {reader.tell()} of {len(reader)} "
                f"({' '.join(str(error).split())}); what stands before was read"
            )
    names = parser.field_names
    used = ("time", "loopIteration", *SIGNALS)
    columns = {
        name: np.array([frame[i] for frame in frames], dtype=float)
        for i, name in enumerate(names)
        if name.startswith(used)
    }
    for name in columns:
        if name.startswith(SIGNALS):
            columns[name] = _unwrapped(columns[name])
    if not frames or "time" not in columns:
        raise log.refusal(" has no frames that can be read")
    _note_missing(columns.pop("loopIteration", np.zeros(0)), log)
    log.add(FRAMES, 0, {IN_NS: columns["time"].astype(np.int64) * NS_PER_US, **columns})
    if (found := log.messages(FRAMES)) is None:
        raise log.refusal(" has no frame with a stamp that a clock gave")
    return parser.headers, found


def _unwrapped(values: FloatArray) -> FloatArray:
    """Return 32-bit numbers as signed ones.

    What is logged is a difference from a prediction, which Betaflight's arithmetic wraps and
    orangebox's does not: a motor at 0, below its least command of 138, is read as 2^32.
    """
    return np.asarray((values + WRAP / 2.0) % WRAP - WRAP / 2.0)


def _note_missing(iterations: Any, log: Log) -> None:
    """Say how many frames the logger or the reader has left out."""
    if len(iterations) < 2:
        return
    steps = np.diff(iterations)
    usual = max(float(np.median(steps)), 1.0)
    gaps = steps[steps > 1.5 * usual]
    if len(gaps):
        missing = round(float((gaps / usual - 1.0).sum()))
        log.findings.doubt(
            f"{missing} of {missing + len(iterations)} frames are missing or damaged, in "
            f"{len(gaps)} places"
        )


def _motors(log: Log, headers: dict[str, Any], count: int) -> tuple[Channel, ...]:
    """Motors of a quadrotor in X, in Betaflight's order."""
    arms = table("betaflight")["quad_x"]
    if count != len(arms):
        raise log.refusal(f" has {count} motors: only quadrotors are known, whose mixer is quad x")
    turned = ", reversed (yaw_motors_reversed)" if headers.get("yaw_motors_reversed") else ""
    if turned:
        other = {"cw": "ccw", "ccw": "cw"}
        arms = [f"{angle} {other[sense]}" for angle, sense in (arm.split() for arm in arms)]
    throttle = [headers.get("minthrottle", 0) or 1000, headers.get("maxthrottle", 0) or 2000]
    low, high = headers.get("motorOutput", throttle)
    said_by = "motorOutput" if "motorOutput" in headers else "minthrottle, maxthrottle"
    log.findings.note(f"motor commands from {low} to {high} ({said_by})")
    log.findings.assume(
        "a quadrotor in X with Betaflight's motor order (rear right, front right, rear left, front "
        f"left), propellers turning inwards at the front{turned}"
    )
    motors = [
        Channel(f"motor_{i}", effect, "motor of quad x", unit="counts")
        for i, effect in enumerate(effects_of_arms(arms), 1)
    ]
    return tuple(over_range(motor, float(low), float(high)) for motor in motors)
