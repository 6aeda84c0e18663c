# SPDX-License-Identifier: Apache-2.0
"""Which messages of an ArduPilot log tell what the actuators did, and what each channel means.

`RCOU` (and `RCO2`, `RCO3`) are the pulse widths at the pins, whose functions are the parameters
``SERVOn_FUNCTION``. Before the mixers are `AETR` (Plane) and `RATE` (Copter, QuadPlane).
"""

import re

import numpy as np

from uav_ident_ros.import_logs.autopilot import Actuators, ActuatorsReader, Import
from uav_ident_ros.import_logs.flight_log import (
    NO_EFFECT,
    Channel,
    Effect,
    unique_names,
)
from uav_ident_ros.import_logs.knowledge import between, effect_of, effects_of_arms, table
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.stamps import join

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

UNNAMED = "no SERVOn_FUNCTION names a surface or a motor of a known frame"


def read_outputs(it: Import) -> Actuators:
    """Read the commands from the messages asked for, or from the best there are.

    Raises
    ------
    ImportLogError
        If there are none, or those asked for are missing or cannot be interpreted.
    """
    found = it.find("actuators", READERS, it.log.messages)
    usable = dict(found)
    if it.choice.actuators_topic is None and "RCOU" in found and not _explained(it.log):
        del usable["RCOU"]
        it.log.findings.lost += [f"RCOU is passed over: {UNNAMED}"] if usable else []
    name = it.choose(usable or found)
    source, t_ns, values, channels = READERS[name](it, found[name])
    it.log.findings.say(f"actuators: {source}, stamped when logged")
    if not any(any(channel.effect) for channel in channels):
        raise it.log.refusal(f": {UNNAMED}")
    return source, t_ns, values, channels


def pin_fields(messages: Messages, first: int = 1) -> dict[int, str]:
    """Return the fields of the pins by number: ``C1`` ..., in old logs ``Ch1`` ..."""
    fields = [name for name in messages.columns if re.fullmatch(r"C(h|han)?\d+", name)]
    numbered = {int(re.sub(r"\D", "", name)): name for name in fields}
    return {number: name for number, name in sorted(numbered.items()) if number >= first}


def _explained(log: Log) -> bool:
    functions = {
        v for name, v in log.parameters.items() if re.fullmatch(r"SERVO\d+_FUNCTION", name)
    }
    return bool(functions & {*SURFACES, *THROTTLES}) or (
        bool(functions & set(MOTORS)) and _frame(log) in FRAMES
    )


def _frame(log: Log) -> tuple[int, int]:
    return int(log.parameter("FRAME_CLASS")), int(log.parameter("FRAME_TYPE", -1))


# --- pins ---------------------------------------------------------------------------------------


def _pins(it: Import, first: Messages) -> Actuators:
    """Pulse widths and the functions of the servo outputs."""
    log, fields = it.log, pin_fields(first)
    t_ns, values = first.stamp_ns, first.values(*fields.values())
    pins, sources = list(fields), [first.name]
    for name in PINS[1:]:
        if (more := log.messages(name)) is not None:
            added = pin_fields(more, len(pins) + 1)
            t_ns, values = join((t_ns, values), (more.stamp_ns, more.values(*added.values())))
            pins += added
            sources.append(name)
    functions = {pin: int(log.parameter(f"SERVO{pin}_FUNCTION")) for pin in pins}
    used = [i for i, pin in enumerate(pins) if functions[pin] or np.any(values[:, i] > 0)]
    channels = _channels(log, {pins[i]: functions[pins[i]] for i in used})
    return " and ".join(sources), t_ns, values[:, used], channels


def _channels(log: Log, functions: dict[int, int]) -> tuple[Channel, ...]:
    every = list(functions.values())
    rotors = _rotors(log, every)
    throttles = sum(function in THROTTLES for function in every)
    names = unique_names([_name(pin, function) for pin, function in functions.items()])
    channels = []
    for name, (pin, function) in zip(names, functions.items(), strict=True):
        if function in SURFACES:
            share = 1.0 / every.count(function)  # two servos of one function: their mean
            effect = effect_of(SURFACES[function], share)
            channels.append(_pulse(log, pin, name, effect, surface=True))
        elif function in THROTTLES:
            channels.append(_pulse(log, pin, name, (0.0, 0.0, 0.0, 1.0 / throttles)))
        elif function in MOTORS:
            effect = rotors.get(MOTORS[function], NO_EFFECT)
            channels.append(_pulse(log, pin, name, effect, motor=True))
        else:
            channels.append(Channel(name, NO_EFFECT, f"SERVO{pin}_FUNCTION {function}", unit="us"))
    log.findings.say(
        "functions, ranges, directions from SERVOn_FUNCTION, _MIN, _TRIM, _MAX, _REVERSED"
    )
    return tuple(channels)


def _name(pin: int, function: int) -> str:
    if function in SURFACES:
        return str(SURFACES[function]["name"])
    if function in MOTORS:
        return f"motor_{MOTORS[function]}"
    return str(THROTTLES.get(function, f"output_{pin}"))


def _pulse(
    log: Log, pin: int, name: str, effect: Effect, *, surface: bool = False, motor: bool = False
) -> Channel:
    """Return a pin that runs from nothing to full, or deflects to both sides of its trim."""
    prefix = f"SERVO{pin}_"
    low, high = log.parameter(f"{prefix}MIN", PWM_MIN), log.parameter(f"{prefix}MAX", PWM_MAX)
    if motor and log.parameter("MOT_PWM_MAX") > 0.0:
        low, high = log.parameter("MOT_PWM_MIN", low), log.parameter("MOT_PWM_MAX")
    sign = -1.0 if log.parameter(f"{prefix}REVERSED") else 1.0
    trim = log.parameter(f"{prefix}TRIM", PWM_TRIM) if surface else None
    if trim is not None and abs(trim - (low + high) / 2.0) > OFF_CENTRE * (high - low):
        log.findings.assume(
            f"{name}: one unit is half of {low:g} to {high:g} us to either side, although its "
            f"trim, {trim:g} us, is off the middle"
        )
    span = f"{low:g} to {high:g}" if trim is None else f"{low:g} {trim:g} {high:g}"
    turned = ", reversed" if sign < 0 else ""
    meaning = f"{prefix}FUNCTION {log.parameter(f'{prefix}FUNCTION'):g}, {span} us{turned}"
    return Channel(name, effect, meaning, *between(low, high, sign, trim), "us")


def _rotors(log: Log, functions: list[int]) -> dict[int, Effect]:
    """Effect of each motor by its number, from the frame."""
    if not any(function in MOTORS for function in functions):
        return {}
    if any(function in SURFACES for function in functions):
        log.findings.assume(
            "a QuadPlane: the surfaces and the forward throttle count, its lift motors are only "
            "recorded"
        )
        return {}
    key = _frame(log)
    if key not in FRAMES:
        raise log.refusal(
            f": FRAME_CLASS {key[0]} and FRAME_TYPE {key[1]} are not known here "
            f"({', '.join(name for name, _ in FRAMES.values())}); try --actuators-topic RATE"
        )
    name, arms = FRAMES[key]
    log.findings.say(
        f"{name} with ArduPilot's motor order and senses of rotation (FRAME_CLASS {key[0]}, "
        f"FRAME_TYPE {key[1]})"
    )
    log.findings.assume(
        "thrust is taken as proportional to the pulse width about its trim (MOT_THST_EXPO bends it)"
    )
    return dict(enumerate(effects_of_arms(arms), 1))


# --- before the mixer -----------------------------------------------------------------------------


def is_old_rate(messages: Messages) -> bool:
    """Whether messages RATE are in the units of before Copter 3.4: its controls are no shares."""
    fields = [field for field in KNOWN["controls"]["RATE"]["fields"] if field in messages]
    asked = [messages.columns[field] for field in fields]
    return any(np.abs(v[np.isfinite(v)]).max(initial=0.0) > NORMALISED for v in asked)


def _demands(it: Import, messages: Messages) -> Actuators:
    """Read the controls before the mixer of a Plane (AETR) or a Copter (RATE)."""
    old = messages.name == "RATE" and is_old_rate(messages)
    known = KNOWN["controls"][f"old {messages.name}" if old else messages.name]
    fields = known["fields"]
    it.log.findings.assume(known["assumed"])
    if missing := [field for field in fields if field not in messages]:
        raise it.log.refusal(
            f": {messages.name} has no {', '.join(missing)}; it has {', '.join(messages.columns)}"
        )
    channels = tuple(
        Channel(entry["name"], effect_of(entry), f"{messages.name}.{field}", 1.0 / entry["unit"])
        for field, entry in fields.items()
    )
    return messages.name, messages.stamp_ns, messages.values(*fields), channels


READERS: dict[str, ActuatorsReader] = {"RCOU": _pins, "RATE": _demands, "AETR": _demands}
"""Readers by message type, nearest to the actuators first."""
