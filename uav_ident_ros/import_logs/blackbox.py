# SPDX-License-Identifier: Apache-2.0
"""Blackbox logs of Betaflight and its kin (`.bbl`, `.bfl`), read by orangebox: multirotors."""

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import (
    Channel,
    Choice,
    Findings,
    FlightLog,
    ImportLogError,
    Stream,
    gyro_and_force,
)
from uav_ident_ros.import_logs.knowledge import between, effects_of_arms, table
from uav_ident_ros.messages.types import NS_PER_US

MAGIC = b"H Product:Blackbox flight data recorder"
"""First bytes of every blackbox log."""

GYROS = ("gyroUnfilt", "gyroADC")
"""Fields of the rates, the preferred first: as sampled, and behind the filters."""


def read_blackbox(
    path: Path,  # Blackbox file
    choice: Choice,  # What to take in place of the best: there is no choice
) -> FlightLog:
    """Read the longest log of a file.

    Raises
    ------
    ImportLogError
        If orangebox is missing, or the file cannot be read, or lacks rates or known motors.
    """
    if choice != Choice():
        raise ImportLogError(f"log '{path}': a blackbox has one set of rates and one of motors")
    findings = Findings()
    headers, fields, values = _read(path, findings)
    t_ns = values[:, fields.index("time")].astype(np.int64) * NS_PER_US
    name = next((gyro for gyro in GYROS if f"{gyro}[2]" in fields), None)
    if name is None:
        raise ImportLogError(f"log '{path}' has no rates (gyroADC); it has {', '.join(fields)}")
    scale = _as_float(headers.get("gyro_scale", 0x3F800000)) * math.pi / 180.0
    rates = _vector(fields, values, name, 3) * scale
    force = None
    if "accSmooth[2]" in fields:
        force = _vector(fields, values, "accSmooth", 3) * GRAVITY / float(headers["acc_1G"])
    else:
        findings.doubt("there is no accelerometer (accSmooth): ay and az are zero")
    findings.say(f"rates: {name}, in body axes forward-left-up")
    if name == GYROS[1]:
        cutoff = headers.get("gyro_lowpass_hz", headers.get("gyro_lpf1_static_hz"))
        findings.doubt(
            "gyroADC is behind the filters"
            + (f" (low-pass at {cutoff} Hz)" if cutoff else "")
            + ": it comes late, which counts as a further delay of the inputs. Betaflight 4.5 logs "
            "gyroUnfilt, too"
        )
    channels = _motors(path, headers, fields, findings)
    commands = _vector(fields, values, "motor", len(channels))
    findings.assume("all of the log counts as flight: a blackbox begins when it is armed")
    streams = {
        "rates": Stream(name, t_ns, gyro_and_force(rates, force)),
        "actuators": Stream("motor", t_ns, commands),
    }
    title = str(headers.get("Firmware revision", headers.get("Firmware type", "blackbox")))
    return FlightLog(path, title, streams, channels, findings, convention="flu", hovers=True)


def _read(path: Path, findings: Findings) -> tuple[dict[str, Any], list[str], FloatArray]:
    """Return headers, names of the fields and the frames, as rows, of the longest log."""
    try:
        from orangebox import Parser
    except ImportError:
        raise ImportLogError(
            f"log '{path}': orangebox is not installed, which reads blackbox logs: "
            "pip install 'uav_ident_ros[blackbox]' or pip install 'orangebox<0.5'"
        ) from None
    logging.getLogger("orangebox").addHandler(logging.NullHandler())  # it is wordy on stderr
    parser = Parser.load(str(path), allow_invalid_header=True)
    starts = [*parser.reader.log_pointers, path.stat().st_size]
    longest = int(np.argmax(np.diff(starts))) + 1
    parser.set_log_index(longest)
    if len(starts) > 2:
        findings.say(f"log {longest} of {len(starts) - 1} in this file, the longest")
    fields = parser.field_names
    frames: list[tuple[float, ...]] = []
    try:
        for frame in parser.frames():
            frames.append(frame.data)
    except Exception as error:  # damaged bytes make a parser fail in many ways
        reader = parser.reader
        if reader.tell() >= len(reader):
            findings.doubt("the file is cut off at its end: what is there was read")
        else:
            findings.damage.append(
                f"the file is damaged: orangebox stopped at byte {reader.tell()} of {len(reader)} "
                f"({' '.join(str(error).split())}); what stands before was read"
            )
    if not frames or "time" not in fields:
        raise ImportLogError(f"log '{path}' has no frames that can be read")
    _say_missing(fields, frames, findings)
    used = [i for i, name in enumerate(fields) if name.startswith(("time", "gyro", "acc", "motor"))]
    rows = np.array([[frame[i] for i in used] for frame in frames], dtype=float)
    return parser.headers, [fields[i] for i in used], rows


def _say_missing(fields: list[str], frames: list[tuple[float, ...]], findings: Findings) -> None:
    """Say how many frames the logger or the reader has left out."""
    if "loopIteration" not in fields or len(frames) < 2:
        return
    place = fields.index("loopIteration")
    steps = np.diff([float(frame[place]) for frame in frames])
    usual = max(float(np.median(steps)), 1.0)
    gaps = steps[steps > 1.5 * usual]
    if len(gaps):
        missing = round(float((gaps / usual - 1.0).sum()))
        findings.doubt(
            f"{missing} of {missing + len(frames)} frames are missing or damaged, in "
            f"{len(gaps)} places"
        )


def _as_float(number: int | float | str) -> float:
    """Return the float whose bits a header gives in hexadecimal digits."""
    bits = int(number, 16) if isinstance(number, str) else int(number)
    return float(np.array([bits], dtype=np.uint32).view(np.float32)[0])


def _vector(fields: list[str], values: FloatArray, name: str, size: int) -> FloatArray:
    return values[:, [fields.index(f"{name}[{i}]") for i in range(size)]]


def _motors(
    path: Path, headers: dict[str, Any], fields: list[str], findings: Findings
) -> tuple[Channel, ...]:
    """Motors of a quadrotor in X, in Betaflight's order."""
    count = sum(name.startswith("motor[") for name in fields)
    arms = table("betaflight")["quad_x"]
    if count != len(arms):
        raise ImportLogError(
            f"log '{path}' has {count} motors: only quadrotors are known, whose mixer is quad x"
        )
    turned = ", reversed (yaw_motors_reversed)" if headers.get("yaw_motors_reversed") else ""
    if turned:
        other = {"cw": "ccw", "ccw": "cw"}
        arms = [f"{angle} {other[sense]}" for angle, sense in (arm.split() for arm in arms)]
    throttle = [headers.get("minthrottle", 0) or 1000, headers.get("maxthrottle", 0) or 2000]
    low, high = headers.get("motorOutput", throttle)
    span = between(float(low), float(high))
    findings.say(f"motor commands from {low} to {high} (motorOutput)")
    findings.assume(
        "a quadrotor in X with Betaflight's motor order (rear right, front right, rear left, front "
        f"left), propellers turning inwards at the front{turned}"
    )
    return tuple(
        Channel(f"motor_{i + 1}", effect, "motor of quad x", *span, "counts")
        for i, effect in enumerate(effects_of_arms(arms))
    )
