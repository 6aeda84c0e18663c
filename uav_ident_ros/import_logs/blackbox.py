# SPDX-License-Identifier: Apache-2.0
"""Blackbox logs of Betaflight and related firmware (`.bbl`, `.bfl`): quadrotors only."""

import logging
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.import_logs.autopilot import Actuators, Import, table
from uav_ident_ros.import_logs.binary import CUT_OFF
from uav_ident_ros.import_logs.flight_log import (
    Channel,
    Choice,
    FlightLog,
    effects_of_arms,
)
from uav_ident_ros.import_logs.log import IN_NS, Column, ImportLogError, Log, LogStream, Messages
from uav_ident_ros.messages.types import NS_PER_US

MAGIC = b"H Product:Blackbox flight data recorder"
"""First bytes of every blackbox log."""

KNOWN = table("betaflight")

SIGNAL_FIELDS = (*KNOWN["rates"], *KNOWN["force"], "motor")
"""Fields of measurements and commands."""

WRAP = 2.0**32
"""Range of Betaflight's 32-bit integers. The log holds differences from a prediction. Betaflight's
arithmetic wraps, that of orangebox does not: it reads a motor at 0, below its least command of 138,
as 2^32."""


def read_blackbox(path: Path, choice: Choice) -> FlightLog:
    """Read the longest log in a file."""
    if choice != Choice():
        raise ImportLogError(f"log '{path}': a blackbox has one set of rates and one of motors")
    log = Log(path)
    headers, frames = _read(log)
    log.title = str(headers.get("Firmware revision", headers.get("Firmware type", "blackbox")))
    log.parameters |= {k: float(v) for k, v in headers.items() if isinstance(v, int | float)}
    t_ns = frames["time"].astype(np.int64) * NS_PER_US
    for name, scale in _scales(log, headers, frames).items():
        columns = {
            signal: v * scale for signal, v in frames.items() if signal.startswith(f"{name}[")
        }
        if columns:
            log.add(name, {IN_NS: t_ns, **columns})
    if not log.kinds:
        raise log.refusal(" has no frame with a plausible stamp")
    importer = _Blackbox(log, KNOWN, choice)
    importer.headers = headers
    return importer.flight_log()


class _Blackbox(Import):
    """Import of a Betaflight log: the motors of its quad x."""

    headers: Mapping[str, Any]  # Headers of the log

    def hovers(self, commands: LogStream) -> bool:
        return True

    def readers(self) -> Mapping[str, Callable[[Messages], Actuators]]:
        return {"motor": self._motors}

    def _motors(self, messages: Messages) -> Actuators:
        """Return the commands and channels of a quadrotor in X, in Betaflight's motor order."""
        log, headers = self.log, self.headers
        values = messages.array("motor")
        turned = ", reversed (yaw_motors_reversed)" if headers.get("yaw_motors_reversed") else ""
        arms = KNOWN["quad_x_reversed" if turned else "quad_x"]
        if values.shape[1] != len(arms):
            raise log.refusal(
                f" has {values.shape[1]} motors: only quadrotors are known, whose mixer is quad x"
            )
        throttle = [headers.get("minthrottle", 0) or 1000, headers.get("maxthrottle", 0) or 2000]
        low, high = headers.get("motorOutput", throttle)
        log.findings.assumed.append(
            "a quadrotor in X with Betaflight's motor order (rear right, front right, rear left, "
            f"front left), propellers turning inwards at the front{turned}"
        )
        motors = [
            Channel(f"motor_{i}", effect, "motor of quad x", unit="counts")
            for i, effect in enumerate(effects_of_arms(arms), 1)
        ]
        channels = [motor.over_range(float(low), float(high)) for motor in motors]
        return LogStream(messages.name, messages.stamp_ns, values), channels


def _scales(log: Log, headers: dict[str, Any], frames: dict[str, Column]) -> dict[str, float]:
    """Return the SI unit of one count of each usable signal, by the first letters of its fields."""
    bits = headers.get("gyro_scale", "0x3f800000")  # bits of a float, in hexadecimal digits
    number = int(bits, 16) if isinstance(bits, str) else int(bits)
    gyro = float(np.uint32(number).view(np.float32)) * math.pi / 180.0
    scales = dict.fromkeys(KNOWN["rates"], gyro) | {"motor": 1.0}
    one_g = float(headers.get("acc_1G", 0))
    measured = [v for name, v in frames.items() if name.startswith("accSmooth")]
    if one_g > 0.0 and np.any(measured):
        scales["accSmooth"] = GRAVITY / one_g
    elif measured:
        log.findings.lost.append(
            "the accelerometer (accSmooth) is off (acc_1G 0, or zero throughout): the model has no "
            "forces"
        )
    return scales


def _read(log: Log) -> tuple[dict[str, Any], dict[str, Column]]:
    """Return the headers and the frames of the longest log in a file."""
    try:
        from orangebox import Parser
    except ImportError:
        raise log.lacks("orangebox", "blackbox logs", "blackbox", "orangebox<0.5") from None
    logging.getLogger("orangebox").addHandler(logging.NullHandler())  # silent on stderr
    parser = Parser.load(str(log.path), allow_invalid_header=True)
    starts = [*parser.reader.log_pointers, log.path.stat().st_size]
    longest = int(np.argmax(np.diff(starts))) + 1
    parser.set_log_index(longest)
    if len(starts) > 2:
        log.findings.read.append(f"log {longest} of {len(starts) - 1} in this file, the longest")
    frames: list[tuple[float, ...]] = []
    skipped = 0  # Places before the last frame: what follows it may be the filling of the memory
    try:
        for frame in parser.frames():
            frames.append(frame.data)
            skipped = parser._ctx.invalid_frame_count
    except Exception as error:  # damaged bytes make a parser fail in many ways
        reader = parser.reader
        if reader.tell() >= len(reader):
            log.findings.lost.append(CUT_OFF)
        else:
            log.findings.damage.append(
                f"the file is damaged: orangebox stopped at byte {reader.tell()} of {len(reader)} "
                f"({' '.join(str(error).split())}); the part before was read"
            )
    if skipped:
        log.findings.damage.append(
            f"orangebox skipped {skipped} place(s) of the file that it could not read as a frame"
        )
    used = ("time", "loopIteration", *SIGNAL_FIELDS)
    columns = {
        name: np.array([frame[i] for frame in frames], dtype=float)
        for i, name in enumerate(parser.field_names)
        if name.startswith(used)
    }
    for name in [name for name in columns if name.startswith(SIGNAL_FIELDS)]:
        columns[name] = (columns[name] + WRAP / 2.0) % WRAP - WRAP / 2.0
    if not frames or "time" not in columns:
        raise log.refusal(" has no frames that can be read")
    _note_missing(columns.pop("loopIteration", np.zeros(0)), log)
    return parser.headers, columns


def _note_missing(iterations: Any, log: Log) -> None:
    """Add the number of missing frames to the findings."""
    if len(iterations) < 2:
        return
    steps = np.diff(iterations)
    usual = max(float(np.median(steps)), 1.0)
    gaps = steps[steps > 1.5 * usual]
    if len(gaps):
        missing = round(float((gaps / usual - 1.0).sum()))
        log.findings.lost.append(
            f"{missing} of {missing + len(iterations)} frames are missing or damaged, in "
            f"{len(gaps)} places"
        )
