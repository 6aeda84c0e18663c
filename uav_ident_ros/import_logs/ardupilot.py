# SPDX-License-Identifier: Apache-2.0
"""ArduPilot dataflash logs (`.bin`): rates, actuator commands, airspeed, parameters.

`RCOU` (and `RCO2`, `RCO3`) are the pulse widths at the pins. The parameters ``SERVOn_FUNCTION``
give the function of each pin. `AETR` (Plane) and `RATE` (Copter, QuadPlane) precede the mixers.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.import_logs.autopilot import Actuators, Import, Usable, kinds, table
from uav_ident_ros.import_logs.dataflash import read_dataflash
from uav_ident_ros.import_logs.flight_log import (
    NO_EFFECT,
    PWM_MAX,
    PWM_MIN,
    PWM_TRIM,
    Channel,
    Choice,
    Effect,
    FlightLog,
    effect_of,
    effects_of_arms,
    named_once,
)
from uav_ident_ros.import_logs.log import ImportLogError, Log, LogStream, Messages

KNOWN = table("ardupilot")
SURFACES, THROTTLES, MOTORS = KNOWN["surfaces"], KNOWN["throttles"], KNOWN["motors"]
FRAMES = {
    (frame["class"], frame["type"]): (name, frame["arms"])
    for name, frame in KNOWN["frames"].items()
}
"""Name and arms by FRAME_CLASS and FRAME_TYPE."""

NAMES = {number: surface["name"] for number, surface in SURFACES.items()} | THROTTLES | MOTORS
"""Names of the actuators that move the aircraft, by SERVOn_FUNCTION."""

OFF_CENTRE = 0.02
"""Largest distance of the trim from mid-range without a finding, as a part of the range."""

PINS = ("RCOU", "RCO2", "RCO3")

NORMALISED = 10.0
"""Limit between demands since Copter 3.4, at most 1, and those before it, in thousands."""


def read_ardupilot(path: Path, choice: Choice) -> FlightLog:
    """Read an ArduPilot dataflash log."""
    if choice.actuators_instance:
        raise ImportLogError(f"log '{path}': ArduPilot logs one set of actuators, instance 0")
    log = read_dataflash(path, kinds(KNOWN) | {*PINS, "DSF"})
    log.title = next((text for text in log.texts if _firmware(text)), "ArduPilot")
    firmware = _firmware(log.title)
    importer = _ArduPilot(log, KNOWN | _of_firmware(log, firmware), choice)
    importer.refuse_others({"it calls itself": firmware})
    _add_present_parameters(log, firmware)
    statistics = log.messages("DSF")
    lost = statistics.columns["Dp"].max() if statistics and statistics.has("Dp") else 0
    if lost:
        log.findings.lost.append(f"the logger lost {lost:.0f} messages (DSF.Dp)")
    return importer.flight_log()


class _ArduPilot(Import):
    """Import of an ArduPilot log: functions of the pins, QuadPlanes."""

    def readers(self) -> Mapping[str, Callable[[Messages], Actuators]]:
        return {"RCOU": self._pins, "RATE": self.demands, "AETR": self.demands}

    def hovers(self, commands: LogStream) -> bool:
        return _firmware(self.log.title) == "Copter" or commands.source == "RATE"

    def explained(self, usable: Usable) -> Usable:
        functions = {
            value
            for name, value in self.log.parameters.items()
            if re.fullmatch(r"SERVO\d+_FUNCTION", name)
        }
        motors = bool(functions & set(MOTORS)) and _frame(self.log) in FRAMES
        explained = dict(usable)
        if not (motors or functions & {*SURFACES, *THROTTLES}) and {"RCOU"} < set(usable):
            self.findings.lost.append(f"RCOU is passed over: {self.table['unexplained']}")
            del explained["RCOU"]
        if _firmware(self.log.title) == "Plane" and {"RATE"} < set(explained):
            self.findings.assumed.append(
                "a QuadPlane in forward flight: RATE, the demands on its lift motors, is passed "
                "over (--actuators-topic RATE for its hover)"
            )
            del explained["RATE"]
        return explained

    def _pins(self, first: Messages) -> Actuators:
        """Read the pulse widths at the pins, with effects from the functions of the pins."""
        log, fields = self.log, _pin_fields(first)
        widths, pins = first.stream(*fields.values()), [*fields]
        for name in PINS[1:]:
            more = log.messages(name)
            if more and (added := _pin_fields(more, len(pins) + 1)):
                widths = widths.joined(more.stream(*added.values()))
                pins += added
        functions = [int(log.parameter(f"SERVO{pin}_FUNCTION")) for pin in pins]
        used = [i for i, f in enumerate(functions) if f or np.any(widths.values[:, i] > 0)]
        effects = _effects(log, [functions[i] for i in used])
        channels = [_channel(log, pins[i], functions[i], effects) for i in used]
        log.findings.read.append(
            "functions, ranges, directions from SERVOn_FUNCTION, _MIN, _TRIM, _MAX, _REVERSED"
        )
        return LogStream(widths.source, widths.t_ns, widths.values[:, used]), named_once(channels)


def _firmware(text: str) -> str:
    """Return the vehicle in a firmware's name: 'Copter' in 'APM:Copter V3.4'; '' if none."""
    vehicles = [*KNOWN["aircraft"], *KNOWN["not_aircraft"]["it calls itself"]]
    found = re.match(rf"(?:Ardu|APM:|Antenna)?({'|'.join(vehicles)})\b.*\bV?\d", text)
    return found[1] if found else ""


def _of_firmware(log: Log, firmware: str) -> dict[str, Any]:
    """Return the table's entries that depend on the firmware: modes, logging options, units."""
    rate = log.messages("RATE")
    result = {
        "modes": KNOWN["modes"].get(firmware, {}),
        "logging": KNOWN["logging"].get(firmware, {"parameter": "LOG_BITMASK", "options": []}),
        "setpoint_unit": np.radians(KNOWN["setpoint_unit"]),
    }
    fields = [f for f in KNOWN["controls"]["RATE"] if rate and rate.has(f)]
    demands = rate.values(*fields) if rate and fields else np.zeros(0)
    if np.abs(demands[np.isfinite(demands)]).max(initial=0.0) > NORMALISED:
        old = KNOWN["old_units"]
        result["setpoint_unit"] *= old["setpoint_unit"]
        result |= {key: KNOWN[key] | old[key] for key in ("controls", "notes")}
    return result


# --- outputs ------------------------------------------------------------------------------------


def _frame(log: Log) -> tuple[int, int]:
    return int(log.parameter("FRAME_CLASS")), int(log.parameter("FRAME_TYPE", -1))


def _pin_fields(messages: Messages, first: int = 1) -> dict[int, str]:
    """Return the fields of the pins by number: ``C1`` ..., in old logs ``Ch1`` ..."""
    fields = [name for name in messages.columns if re.fullmatch(r"C(h|han)?\d+", name)]
    numbered = {int(re.sub(r"\D", "", name)): name for name in fields}
    return {number: name for number, name in sorted(numbered.items()) if number >= first}


def _channel(log: Log, pin: int, function: int, effects: Mapping[int, Effect]) -> Channel:
    """Return the channel of a pin, from its function and the parameters of its range."""
    prefix, meaning = f"SERVO{pin}_", f"SERVO{pin}_FUNCTION {function}"
    if function not in NAMES:
        return Channel(f"output_{pin}", NO_EFFECT, meaning, unit="us")
    low, high = log.parameter(f"{prefix}MIN", PWM_MIN), log.parameter(f"{prefix}MAX", PWM_MAX)
    name, trim = NAMES[function], None
    if function in SURFACES:
        trim = log.parameter(f"{prefix}TRIM", PWM_TRIM)
        if abs(trim - (low + high) / 2.0) > OFF_CENTRE * (high - low):
            log.findings.assumed.append(
                f"{name}: one unit is half of {low:g} to {high:g} us to either side, although its "
                f"trim, {trim:g} us, is off the middle"
            )
    elif function in MOTORS and log.parameter("MOT_PWM_MAX") > 0.0:
        low, high = log.parameter("MOT_PWM_MIN", low), log.parameter("MOT_PWM_MAX")
    turned = log.parameter(f"{prefix}REVERSED") != 0.0
    channel = Channel(name, effects.get(function, NO_EFFECT), meaning, unit="us")
    return channel.over_range(low, high, centre=trim, turned=turned)


def _effects(log: Log, functions: list[int]) -> dict[int, Effect]:
    """Return the effect of each function; pins of one function share it equally."""
    effects = {
        function: effect_of(SURFACES[function], 1.0 / functions.count(function))
        for function in functions
        if function in SURFACES
    }
    lifts, has_wings = any(function in MOTORS for function in functions), bool(effects)
    if throttles := [function for function in functions if function in THROTTLES]:
        effects |= dict.fromkeys(throttles, effect_of({"thrust": 1.0 / len(throttles)}))
    if lifts and has_wings:
        log.findings.assumed.append(
            "a QuadPlane: the surfaces and the forward throttle count, its lift motors are only "
            "recorded"
        )
    elif lifts:
        key = _frame(log)
        if key not in FRAMES:
            raise log.refusal(
                f": FRAME_CLASS {key[0]} and FRAME_TYPE {key[1]} are not known here "
                f"({', '.join(name for name, _ in FRAMES.values())}); try --actuators-topic RATE"
            )
        name, arms = FRAMES[key]
        effects |= dict(zip(MOTORS, effects_of_arms(arms), strict=False))
        log.findings.read.append(
            f"{name} with ArduPilot's motor order and senses of rotation (FRAME_CLASS {key[0]}, "
            f"FRAME_TYPE {key[1]})"
        )
        log.findings.assumed.append(
            "thrust is taken as proportional to the pulse width about its trim (MOT_THST_EXPO "
            "bends it)"
        )
    return effects


# --- before SERVOn_FUNCTION ---------------------------------------------------------------------


def _add_present_parameters(log: Log, firmware: str) -> None:
    """Add parameters with the present names to an old log, derived from its own parameters.

    Before Copter 3.5 and Plane 3.8 no parameter gave the functions of a plane's pins 1 to 4 and of
    a copter's motor pins. They followed from ``FRAME`` and the sticks' channels (``RCMAP_*``).
    Ranges and directions were those of the radio's channels, ``RCn_MIN, TRIM, MAX, REV``.
    """
    parameters = log.parameters
    if any(name.startswith("SERVO") and name.endswith("_FUNCTION") for name in parameters):
        return
    if "FRAME" in parameters and firmware in ("Copter", ""):
        _old_copter(log)
    elif firmware == "Plane" or (not firmware and "LIM_ROLL_CD" in parameters):
        _old_plane(log)


def _set_pin(log: Log, pin: int, function: int, stick: int) -> None:
    """Set the function of a pin, and its range to that of a channel of the radio."""
    added = {f"SERVO{pin}_FUNCTION": float(function)}
    for end in ("MIN", "TRIM", "MAX"):
        if (reach := log.parameters.get(f"RC{stick}_{end}")) is not None:
            added[f"SERVO{pin}_{end}"] = reach
    log.parameters.update(added | log.parameters)


def _old_copter(log: Log) -> None:
    """Assign the motors to the first pins, in the frame's order, with the throttle's range."""
    frames = [match[1] for text in log.texts if (match := re.fullmatch(r"Frame: (\w+)", text))]
    if frames:
        frame_class = KNOWN["old_frames"].get(frames[0])
    else:
        pulses = log.messages("RCOU")
        fields = _pin_fields(pulses).values() if pulses else ()
        moving = [bool(np.ptp(pulses.columns[field])) for field in fields] if pulses else []
        used = [*moving, False].index(False)
        frame_class = KNOWN["old_motor_counts"].get(used)
        log.findings.assumed.append(f"{used} pins carry pulses: they are its motors")
    log.parameters.setdefault("FRAME_CLASS", float(frame_class or 0))
    log.parameters.setdefault("FRAME_TYPE", log.parameters["FRAME"])
    _, arms = FRAMES.get(_frame(log), ("", []))
    for pin, (function, _) in enumerate(zip(MOTORS, arms, strict=False), 1):
        _set_pin(log, pin, function, KNOWN["throttle_stick"])
    if arms:
        log.findings.assumed.append(
            "a log without SERVOn_FUNCTION: the motors are on the pins of their numbers, their "
            f"range is the throttle's (RC{KNOWN['throttle_stick']}_MIN, MAX)"
        )


def _old_plane(log: Log) -> None:
    """Assign the surfaces to the pins of the sticks' channels; others follow RCn_FUNCTION."""
    parameters = log.parameters
    if paired := [name for name in KNOWN["old_pairs"] if parameters.get(name)]:
        log.findings.lost.append(
            f"{paired[0]} is {parameters[paired[0]]:g}: how such pairs turn is not known here"
        )
        return
    sticks = enumerate(KNOWN["old_plane"].items(), 1)
    pins = {int(parameters.get(stick, i)): function for i, (stick, function) in sticks}
    for name, value in parameters.items():
        if found := re.fullmatch(r"RC(\d+)_FUNCTION", name):
            pins.setdefault(int(found[1]), int(value))
    for pin, function in pins.items():
        _set_pin(log, pin, function, pin)
        turned = float(log.parameter(f"RC{pin}_REV", 1.0) < 0)
        parameters.setdefault(f"SERVO{pin}_REVERSED", turned)
    log.findings.assumed.append(
        "a log without SERVOn_FUNCTION: aileron, elevator, throttle, rudder are on the pins of "
        "their sticks (RCMAP_*), ranges and directions are those of RCn_MIN, TRIM, MAX, REV"
    )
