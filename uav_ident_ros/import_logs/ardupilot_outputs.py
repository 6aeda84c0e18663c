# SPDX-License-Identifier: Apache-2.0
"""Which messages of an ArduPilot log tell what the actuators did, and what each channel means.

`RCOU` (and `RCO2`, `RCO3`) are the pulse widths at the pins, whose functions are the parameters
``SERVOn_FUNCTION``. Before the mixers are `AETR` (Plane) and `RATE` (Copter, QuadPlane).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import choose, find_messages
from uav_ident_ros.import_logs.flight_log import (
    NO_EFFECT,
    Actuators,
    Channel,
    Effect,
    Findings,
    ImportLogError,
    unique_names,
)
from uav_ident_ros.import_logs.knowledge import effect_of, effects_of_arms, table
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.stamps import Stretches, join

KNOWN = table("ardupilot")
SURFACES, THROTTLES, MOTORS = KNOWN["surfaces"], KNOWN["throttles"], KNOWN["motors"]
FRAMES = {
    (frame["class"], frame["type"]): (name, frame["arms"])
    for name, frame in KNOWN["frames"].items()
}
"""Name and arms by FRAME_CLASS and FRAME_TYPE."""

PWM_MIN, PWM_TRIM, PWM_MAX = 1000.0, 1500.0, 2000.0
"""Pulse widths of least, rest and full where no parameter says, us."""

NORMALISED = 10.0
"""Demands beyond this are in the units before Copter 3.4, thousands: none is above one since."""

OFF_CENTRE = 0.02
"""A trim further from the middle than this part of the range is worth a word."""

PINS = ("RCOU", "RCO2", "RCO3")


BEFORE_MIXER = ("RATE", "AETR")


def read_outputs(log: Log, findings: Findings, wanted: str | None, flight: Stretches) -> Actuators:
    """Read the commands from the messages asked for, or from the best there are.

    Raises
    ------
    ImportLogError
        If there are none, or those asked for are missing or cannot be interpreted.
    """
    found = find_messages(log, "actuators", READERS, wanted, 0, log.messages)
    usable = {name: m for name, m in found.items() if wanted or name != "RCOU" or _explained(log)}
    usable = usable or found
    if len(usable) < len(found):
        findings.lost.append(
            "RCOU is passed over: no SERVOn_FUNCTION names a surface or a motor of a known frame"
        )
    streams = {name: (messages.stamp_ns, messages.rate) for name, messages in usable.items()}
    name = choose(streams, flight, findings, "LOG_BITMASK", BEFORE_MIXER)
    actuators = READERS[name](log, usable[name], findings)
    findings.read.append(f"actuators: {actuators.source}, stamped when logged")
    if not any(any(channel.effect) for channel in actuators.channels):
        raise ImportLogError(
            f"log '{log.path}': no SERVOn_FUNCTION names a surface or a motor of a known frame"
        )
    return actuators


def _explained(log: Log) -> bool:
    """Whether the parameters say what some pin moves."""
    functions = [
        v for name, v in log.parameters.items() if re.fullmatch(r"SERVO\d+_FUNCTION", name)
    ]
    if any(function in SURFACES or function in THROTTLES for function in functions):
        return True
    return any(function in MOTORS for function in functions) and _frame(log) in FRAMES


def _frame(log: Log) -> tuple[int, int]:
    parameters = log.parameters
    return int(parameters.get("FRAME_CLASS", 0)), int(parameters.get("FRAME_TYPE", -1))


# --- pins ---------------------------------------------------------------------------------------


def _pins(log: Log, first: Messages, findings: Findings) -> Actuators:
    """Pulse widths and the functions of the servo outputs."""
    numbers = _pin_numbers(first, 1)
    t_ns, values = first.stamp_ns, first.values(*numbers.values())
    pins = list(numbers)
    for name in PINS[1:]:
        more = log.messages(name)
        if more is None:
            continue
        added = _pin_numbers(more, len(pins) + 1)
        t_ns, values = join((t_ns, values), (more.stamp_ns, more.values(*added.values())))
        pins += added
    used = [i for i, pin in enumerate(pins) if _function(log, pin) or np.any(values[:, i] > 0)]
    functions = {pins[i]: _function(log, pins[i]) for i in used}
    channels = _channels(log, functions, findings)
    sources = [name for name in PINS if log.messages(name) is not None]
    return Actuators(" and ".join(sources), t_ns, values[:, used], tuple(channels))


def _pin_numbers(messages: Messages, first: int) -> dict[int, str]:
    """Fields of the pins by number: ``C1`` ..., in old logs ``Ch1`` ..."""
    fields = [name for name in messages.columns if re.fullmatch(r"C(h|han)?\d+", name)]
    numbered = {int(re.sub(r"\D", "", name)): name for name in fields}
    return {number: name for number, name in sorted(numbered.items()) if number >= first}


def _function(log: Log, pin: int) -> int:
    return int(log.parameters.get(f"SERVO{pin}_FUNCTION", 0))


def _channels(log: Log, functions: dict[int, int], findings: Findings) -> list[Channel]:
    """Meaning of each pin."""
    surfaces = any(function in SURFACES for function in functions.values())
    rotors = _rotors(log, functions, findings, surfaces)
    counts = {f: list(functions.values()).count(f) for f in set(functions.values())}
    throttles = sum(function in THROTTLES for function in functions.values())
    names = unique_names([_name(pin, function) for pin, function in functions.items()])
    channels = []
    for name, (pin, function) in zip(names, functions.items(), strict=True):
        where = f"SERVO{pin}_FUNCTION {function}"
        if function in SURFACES:
            share = 1.0 / counts[function]  # two servos of one function: their mean
            effect = effect_of(SURFACES[function], share)
            channels.append(_surface(log, pin, name, effect, where, findings))
        elif function in THROTTLES:
            effect = (0.0, 0.0, 0.0, 1.0 / throttles)
            channels.append(
                _range(log, pin, name, effect, where, f"SERVO{pin}_MIN", f"SERVO{pin}_MAX")
            )
        elif function in MOTORS:
            effect = rotors.get(MOTORS[function], NO_EFFECT)
            channels.append(_range(log, pin, name, effect, where, "MOT_PWM_MIN", "MOT_PWM_MAX"))
        else:
            channels.append(Channel(name, NO_EFFECT, where, unit="us"))
    findings.read.append(
        "functions, ranges, directions from SERVOn_FUNCTION, _MIN, _TRIM, _MAX, _REVERSED"
    )
    return channels


def _name(pin: int, function: int) -> str:
    if function in SURFACES:
        return str(SURFACES[function]["name"])
    if function in MOTORS:
        return f"motor_{MOTORS[function]}"
    return str(THROTTLES.get(function, f"output_{pin}"))


def _surface(
    log: Log, pin: int, name: str, effect: Effect, where: str, findings: Findings
) -> Channel:
    """Return a pin that deflects to both sides of its trim."""
    low, high, sign = _limits(log, pin)
    trim = float(log.parameters.get(f"SERVO{pin}_TRIM", PWM_TRIM))
    if abs(trim - (low + high) / 2.0) > OFF_CENTRE * (high - low):
        findings.assumed.append(
            f"{name}: one unit is half of {low:g} to {high:g} us to either side, although its "
            f"trim, {trim:g} us, is off the middle"
        )
    meaning = f"{where}, {low:g} {trim:g} {high:g} us{', reversed' if sign < 0 else ''}"
    return Channel(name, effect, meaning, 2.0 * sign / (high - low), trim, "us")


def _range(
    log: Log, pin: int, name: str, effect: Effect, where: str, lowest: str, highest: str
) -> Channel:
    """Return a pin that runs from nothing to full."""
    low, high, sign = _limits(log, pin)
    if log.parameters.get(highest, 0.0) > 0.0:
        low, high = float(log.parameters.get(lowest, low)), float(log.parameters[highest])
    neutral = low if sign > 0 else high
    return Channel(
        name, effect, f"{where}, {low:g} to {high:g} us", sign / (high - low), neutral, "us"
    )


def _limits(log: Log, pin: int) -> tuple[float, float, float]:
    """Return least and greatest pulse width, us, and the direction."""
    low = float(log.parameters.get(f"SERVO{pin}_MIN", PWM_MIN))
    high = float(log.parameters.get(f"SERVO{pin}_MAX", PWM_MAX))
    if not high > low:
        raise ImportLogError(
            f"log '{log.path}': SERVO{pin}_MIN is {low:g} and SERVO{pin}_MAX is {high:g}: no range"
        )
    return low, high, -1.0 if log.parameters.get(f"SERVO{pin}_REVERSED", 0.0) else 1.0


def _rotors(
    log: Log, functions: dict[int, int], findings: Findings, surfaces: bool
) -> dict[int, Effect]:
    """Effect of each motor by its number, from the frame."""
    motors = [MOTORS[function] for function in functions.values() if function in MOTORS]
    if not motors:
        return {}
    if surfaces:
        findings.assumed.append(
            "a QuadPlane: the surfaces and the forward throttle count, its lift motors are only "
            "recorded"
        )
        return {}
    key = _frame(log)
    if key not in FRAMES:
        raise ImportLogError(
            f"log '{log.path}': FRAME_CLASS {key[0]} and FRAME_TYPE {key[1]} are not known here "
            f"({', '.join(name for name, _ in FRAMES.values())}); try --actuators-topic RATE"
        )
    name, arms = FRAMES[key]
    effects = effects_of_arms(arms)
    findings.read.append(
        f"{name} with ArduPilot's motor order and senses of rotation (FRAME_CLASS {key[0]}, "
        f"FRAME_TYPE {key[1]})"
    )
    findings.assumed.append(
        "thrust is taken as proportional to the pulse width about its trim (MOT_THST_EXPO bends it)"
    )
    return {number + 1: effect for number, effect in enumerate(effects)}


# --- before the mixer -----------------------------------------------------------------------------


def _aetr(log: Log, messages: Messages, findings: Findings) -> Actuators:
    """Plane's controls before its mixer."""
    findings.assumed.append(
        "AETR: full deflection is 4500, full throttle 100 (older logs: throttle in the same unit)"
    )
    return _demands(log, messages, KNOWN["controls"]["AETR"])


def is_old_rate(messages: Messages) -> bool:
    """Whether messages RATE are in the units of before Copter 3.4: its controls are no shares."""
    fields = [field for field in KNOWN["controls"]["RATE"] if field in messages]
    asked = [messages.columns[field] for field in fields]
    return any(np.abs(v[np.isfinite(v)]).max(initial=0.0) > NORMALISED for v in asked)


def _rate(log: Log, messages: Messages, findings: Findings) -> Actuators:
    """Copter's controls before its mixer."""
    findings.assumed.append("the mixer delivers what RATE asks for: it knows no saturation")
    known = KNOWN["controls"]["RATE"]
    if is_old_rate(messages):
        known = KNOWN["controls"]["old RATE"]
        findings.assumed.append(
            "RATE: full demand is 4500, full throttle 1000, as before Copter 3.4"
        )
    return _demands(log, messages, known)


def _demands(log: Log, messages: Messages, known: Mapping[str, Mapping[str, Any]]) -> Actuators:
    missing = [field for field in known if field not in messages]
    if missing:
        raise ImportLogError(
            f"log '{log.path}': {messages.name} has no {', '.join(missing)}; it has "
            f"{', '.join(messages.columns)}"
        )
    values: FloatArray = messages.values(*known)
    channels = tuple(
        Channel(entry["name"], effect_of(entry), f"{messages.name}.{field}", 1.0 / entry["unit"])
        for field, entry in known.items()
    )
    return Actuators(messages.name, messages.stamp_ns, values, channels)


READERS: dict[str, Callable[[Log, Messages, Findings], Actuators]] = {
    "RCOU": _pins,
    "RATE": _rate,
    "AETR": _aetr,
}
"""Readers by message type, nearest to the actuators first."""
