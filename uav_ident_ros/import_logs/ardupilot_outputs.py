# SPDX-License-Identifier: Apache-2.0
"""Which messages of an ArduPilot log tell what the actuators did, and what each channel means.

`RCOU` (and `RCO2`, `RCO3`) are the pulse widths at the pins, whose functions are the parameters
``SERVOn_FUNCTION``. Before the mixers are `AETR` (Plane) and `RATE` (Copter, QuadPlane).
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import find_messages, first_fast
from uav_ident_ros.import_logs.dataflash import DataflashLog, Messages
from uav_ident_ros.import_logs.flight_log import (
    NO_EFFECT,
    Actuators,
    Channel,
    Effect,
    Findings,
    ImportLogError,
    unique_names,
)
from uav_ident_ros.import_logs.mixing import from_torques, on_a_circle, rotor_effects
from uav_ident_ros.import_logs.stamps import join

HALF = 0.5
"""Each of a pair: the input is the mean of their deflections, as with elevons in config/."""

SURFACES: dict[int, tuple[str, Effect]] = {
    4: ("aileron", from_torques(1.0, 0.0, 0.0)),
    19: ("elevator", from_torques(0.0, 1.0, 0.0)),
    21: ("rudder", from_torques(0.0, 0.0, 1.0)),
    24: ("left_flaperon", from_torques(HALF, 0.0, 0.0)),
    25: ("right_flaperon", from_torques(HALF, 0.0, 0.0)),
    77: ("left_elevon", from_torques(-HALF, HALF, 0.0)),
    78: ("right_elevon", from_torques(HALF, HALF, 0.0)),
    79: ("left_vtail", from_torques(0.0, HALF, HALF)),
    80: ("right_vtail", from_torques(0.0, HALF, -HALF)),
}
"""SERVOn_FUNCTION of the surfaces. Plane mixes elevons as elevator -/+ aileron (left/right) and
tails as elevator +/- rudder; positive is pitch up, roll right, yaw right."""

THROTTLES = {70: "throttle", 73: "left_throttle", 74: "right_throttle"}

MOTORS = {**{33 + i: i + 1 for i in range(8)}, **{82 + i: i + 9 for i in range(4)}}
"""Number of the motor by SERVOn_FUNCTION."""

CCW, CW = 1.0, -1.0

FRAMES: dict[tuple[int, int], tuple[str, tuple[tuple[float, float], ...]]] = {
    (1, 0): ("quad plus", ((90, CCW), (-90, CCW), (0, CW), (180, CW))),
    (1, 1): ("quad x", ((45, CCW), (-135, CCW), (-45, CW), (135, CW))),
    (1, 3): ("quad h", ((45, CW), (-135, CW), (-45, CCW), (135, CCW))),
    (2, 0): ("hexa plus", ((0, CW), (180, CCW), (-120, CW), (60, CCW), (-60, CCW), (120, CW))),
    (2, 1): ("hexa x", ((90, CW), (-90, CCW), (-30, CW), (150, CCW), (30, CCW), (-150, CW))),
    (3, 0): (
        "octa plus",
        ((0, CW), (180, CW), (45, CCW), (135, CCW), (-45, CCW), (-135, CCW), (-90, CW), (90, CW)),
    ),
    (3, 1): (
        "octa x",
        (
            (22.5, CW),
            (-157.5, CW),
            (67.5, CCW),
            (157.5, CCW),
            (-22.5, CCW),
            (-112.5, CCW),
            (-67.5, CW),
            (112.5, CW),
        ),
    ),
    (4, 1): (
        "octaquad x",
        (
            (45, CCW),
            (-45, CW),
            (-135, CCW),
            (135, CW),
            (-45, CCW),
            (45, CW),
            (135, CCW),
            (-135, CW),
        ),
    ),
}
"""Arms (clockwise from the nose, deg) and senses of rotation of motors 1, 2 ... by FRAME_CLASS and
FRAME_TYPE, as ArduPilot's AP_MotorsMatrix sets them up."""

PWM_MIN, PWM_TRIM, PWM_MAX = 1000.0, 1500.0, 2000.0
"""Pulse widths of least, rest and full where no parameter says, us."""

ANGLE_RANGE, THROTTLE_RANGE = 4500.0, 100.0
"""Full scale of AETR: hundredths of a degree by name, full deflection by use; percent."""

OFF_CENTRE = 0.02
"""A trim further from the middle than this part of the range is worth a word."""

PINS = ("RCOU", "RCO2", "RCO3")


def read_outputs(log: DataflashLog, findings: Findings, wanted: str | None) -> Actuators:
    """Read the commands from the messages asked for, or from the best there are.

    Raises
    ------
    ImportLogError
        If there are none, or those asked for are missing or cannot be interpreted.
    """
    usable = find_messages(log, "actuators", READERS, wanted, 0, log.messages)
    name = first_fast({name: messages.rate for name, messages in usable.items()})
    for passed in list(usable)[: list(usable).index(name)]:
        findings.lost.append(
            f"{passed} is logged at {usable[passed].rate:.0f} Hz only (LOG_BITMASK); {name}, at "
            f"{usable[name].rate:.0f} Hz, is from before the mixer and knows nothing of saturation"
        )
    actuators = READERS[name](log, usable[name], findings)
    findings.read.append(f"actuators: {actuators.source}, stamped when logged (TimeUS)")
    if others := [n for n in usable if n != name]:
        findings.read.append(f"other actuator messages, not used: {', '.join(others)}")
    if not any(any(channel.effect) for channel in actuators.channels):
        raise ImportLogError(
            f"log '{log.path}': no SERVOn_FUNCTION names a surface or a motor of a known frame"
        )
    return actuators


# --- pins ---------------------------------------------------------------------------------------


def _pins(log: DataflashLog, first: Messages, findings: Findings) -> Actuators:
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
    fields = [name for name in messages.columns if re.fullmatch(r"Ch?\d+", name)]
    numbered = {int(re.sub(r"\D", "", name)): name for name in fields}
    return {number: name for number, name in sorted(numbered.items()) if number >= first}


def _function(log: DataflashLog, pin: int) -> int:
    return int(log.parameters.get(f"SERVO{pin}_FUNCTION", 0))


def _channels(log: DataflashLog, functions: dict[int, int], findings: Findings) -> list[Channel]:
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
            effect = SURFACES[function][1]
            scaled = (effect[0] * share, effect[1] * share, effect[2] * share, effect[3] * share)
            channels.append(_surface(log, pin, name, scaled, where, findings))
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
        return SURFACES[function][0]
    if function in MOTORS:
        return f"motor_{MOTORS[function]}"
    return THROTTLES.get(function, f"output_{pin}")


def _surface(
    log: DataflashLog, pin: int, name: str, effect: Effect, where: str, findings: Findings
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
    log: DataflashLog, pin: int, name: str, effect: Effect, where: str, lowest: str, highest: str
) -> Channel:
    """Return a pin that runs from nothing to full."""
    low, high, sign = _limits(log, pin)
    if log.parameters.get(highest, 0.0) > 0.0:
        low, high = float(log.parameters.get(lowest, low)), float(log.parameters[highest])
    neutral = low if sign > 0 else high
    return Channel(
        name, effect, f"{where}, {low:g} to {high:g} us", sign / (high - low), neutral, "us"
    )


def _limits(log: DataflashLog, pin: int) -> tuple[float, float, float]:
    """Return least and greatest pulse width, us, and the direction."""
    low = float(log.parameters.get(f"SERVO{pin}_MIN", PWM_MIN))
    high = float(log.parameters.get(f"SERVO{pin}_MAX", PWM_MAX))
    if not high > low:
        raise ImportLogError(
            f"log '{log.path}': SERVO{pin}_MIN is {low:g} and SERVO{pin}_MAX is {high:g}: no range"
        )
    return low, high, -1.0 if log.parameters.get(f"SERVO{pin}_REVERSED", 0.0) else 1.0


def _rotors(
    log: DataflashLog, functions: dict[int, int], findings: Findings, surfaces: bool
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
    key = (
        int(log.parameters.get("FRAME_CLASS", 0)),
        int(log.parameters.get("FRAME_TYPE", -1)),
    )
    if key not in FRAMES:
        raise ImportLogError(
            f"log '{log.path}': FRAME_CLASS {key[0]} and FRAME_TYPE {key[1]} are not known here "
            f"({', '.join(name for name, _ in FRAMES.values())}); try --actuators-topic RATE"
        )
    name, arms = FRAMES[key]
    effects = rotor_effects(
        on_a_circle([angle for angle, _ in arms]), [turn for _, turn in arms], [1.0] * len(arms)
    )
    findings.read.append(
        f"{name} with ArduPilot's motor order and senses of rotation (FRAME_CLASS {key[0]}, "
        f"FRAME_TYPE {key[1]})"
    )
    findings.assumed.append(
        "thrust is taken as proportional to the pulse width about its trim (MOT_THST_EXPO bends it)"
    )
    return {number + 1: effect for number, effect in enumerate(effects)}


# --- before the mixer -----------------------------------------------------------------------------


def _aetr(log: DataflashLog, messages: Messages, findings: Findings) -> Actuators:
    """Plane's controls before its mixer."""
    findings.assumed.append(
        "AETR: full deflection is 4500, full throttle 100 (older logs: throttle in the same unit)"
    )
    table = {
        "Ail": ("aileron", from_torques(1.0, 0.0, 0.0), 1.0 / ANGLE_RANGE),
        "Elev": ("elevator", from_torques(0.0, 1.0, 0.0), 1.0 / ANGLE_RANGE),
        "Rudd": ("rudder", from_torques(0.0, 0.0, 1.0), 1.0 / ANGLE_RANGE),
        "Thr": ("throttle", from_torques(0.0, 0.0, 0.0, 1.0), 1.0 / THROTTLE_RANGE),
    }
    return _demands(log, messages, table)


def _rate(log: DataflashLog, messages: Messages, findings: Findings) -> Actuators:
    """Copter's controls before its mixer."""
    findings.assumed.append("the mixer delivers what RATE asks for: it knows no saturation")
    table = {
        "ROut": ("roll", from_torques(1.0, 0.0, 0.0), 1.0),
        "POut": ("pitch", from_torques(0.0, 1.0, 0.0), 1.0),
        "YOut": ("yaw", from_torques(0.0, 0.0, 1.0), 1.0),
        "AOut": ("throttle", from_torques(0.0, 0.0, 0.0, 1.0), 1.0),
    }
    return _demands(log, messages, table)


def _demands(
    log: DataflashLog, messages: Messages, table: dict[str, tuple[str, Effect, float]]
) -> Actuators:
    missing = [field for field in table if field not in messages]
    if missing:
        raise ImportLogError(
            f"log '{log.path}': {messages.name} has no {', '.join(missing)}; it has "
            f"{', '.join(messages.columns)}"
        )
    values: FloatArray = messages.values(*table)
    channels = tuple(
        Channel(name, effect, f"{messages.name}.{field}", scale)
        for field, (name, effect, scale) in table.items()
    )
    return Actuators(messages.name, messages.stamp_ns, values, channels)


READERS: dict[str, Callable[[DataflashLog, Messages, Findings], Actuators]] = {
    "RCOU": _pins,
    "RATE": _rate,
    "AETR": _aetr,
}
"""Readers by message type, nearest to the actuators first."""
