# SPDX-License-Identifier: Apache-2.0
"""Parameters of old ArduPilot logs under their names of today.

Before Copter 3.5 and Plane 3.8 no parameter said what pins 1 to 4 of a plane or the motors' pins of
a copter move: the firmware knew, from ``FRAME`` and the sticks' channels (``RCMAP_*``). Ranges and
directions were those of the radio's channels, ``RCn_MIN, TRIM, MAX, REV``.
"""

from __future__ import annotations

import re

import numpy as np

from uav_ident_ros.import_logs.ardupilot_outputs import FRAMES, pin_fields
from uav_ident_ros.import_logs.knowledge import table
from uav_ident_ros.import_logs.log import Log

RANGES = ("MIN", "TRIM", "MAX")
PAIRED = ("ELEVON_MIXING", "ELEVON_OUTPUT", "VTAIL_OUTPUT", "FLAPERON_OUTPUT", "MIXING_OUTPUT")
"""Old parameters of pairs of surfaces, whose senses have names no more."""

STICK = "RC3_"
"""The throttle's."""


def name_as_today(log: Log, firmware: str) -> None:
    """Add parameters to an old log, under today's names, as far as they follow from its own."""
    parameters = log.parameters
    if any(name.startswith("SERVO") and name.endswith("_FUNCTION") for name in parameters):
        return
    if "FRAME" in parameters and firmware in ("Copter", ""):
        parameters.update(_copter(log) | parameters)
    elif firmware == "Plane" or (not firmware and "LIM_ROLL_CD" in parameters):
        parameters.update(_plane(log) | parameters)


def _copter(log: Log) -> dict[str, float]:
    """Motors on the first pins, in the order of the frame."""
    parameters, known = log.parameters, table("ardupilot")
    said = [match[1] for text in log.texts if (match := re.fullmatch(r"Frame: (\w+)", text))]
    frame_class = known["old_frames"].get(said[0]) if said else None
    if not said:
        used = _pins_with_pulses(log)
        frame_class = known["old_motor_counts"].get(used)
        log.findings.assume(f"{used} pins carry pulses: they are its motors")
    frame = {"FRAME_CLASS": float(frame_class or 0), "FRAME_TYPE": parameters["FRAME"]}
    _, arms = FRAMES.get((frame["FRAME_CLASS"], frame["FRAME_TYPE"]), ("", []))
    functions = {number: function for function, number in known["motors"].items()}
    for number in range(1, len(arms) + 1):
        frame[f"SERVO{number}_FUNCTION"] = functions[number]
        for end in ("MIN", "MAX"):
            if (value := parameters.get(f"{STICK}{end}")) is not None:
                frame[f"SERVO{number}_{end}"] = value
    if arms:
        log.findings.assume(
            "a log without SERVOn_FUNCTION: the motors are on the pins of their numbers, their "
            f"range is the throttle's ({STICK}MIN, MAX)"
        )
    return frame


def _pins_with_pulses(log: Log) -> int:
    """Count the pins, from the first on, that carry changing pulses."""
    if (pulses := log.messages("RCOU")) is None:
        return 0
    moving = [bool(np.ptp(pulses.columns[field])) for field in pin_fields(pulses).values()]
    return [*moving, False].index(False)


def _plane(log: Log) -> dict[str, float]:
    """Surfaces on the pins of the sticks' channels, and what RCn_FUNCTION says of the others."""
    parameters = log.parameters
    if paired := [name for name in PAIRED if parameters.get(name)]:
        log.findings.doubt(
            f"{paired[0]} is {parameters[paired[0]]:g}: how such pairs turn is not known here"
        )
        return {}
    result: dict[str, float] = {}
    pins = {int(parameters.get(s, i)): f
            for i, (s, f) in enumerate(table("ardupilot")["old_plane"].items(), 1)}  # fmt: skip
    for name, value in parameters.items():
        if found := re.fullmatch(r"RC(\d+)_FUNCTION", name):
            pins.setdefault(int(found[1]), int(value))
    for pin, function in pins.items():
        result[f"SERVO{pin}_FUNCTION"] = function
        for end in RANGES:
            if (reach := parameters.get(f"RC{pin}_{end}")) is not None:
                result[f"SERVO{pin}_{end}"] = reach
        result[f"SERVO{pin}_REVERSED"] = float(parameters.get(f"RC{pin}_REV", 1.0) < 0)
    log.findings.assume(
        "a log without SERVOn_FUNCTION: aileron, elevator, throttle, rudder are on the pins of "
        "their sticks (RCMAP_*), ranges and directions are those of RCn_MIN, TRIM, MAX, REV"
    )
    return result
