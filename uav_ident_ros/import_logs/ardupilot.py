# SPDX-License-Identifier: Apache-2.0
"""ArduPilot dataflash logs (`.bin`): rates, outputs, airspeed and what the log says of them."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.ardupilot_outputs import (
    FRAMES,
    PINS,
    READERS,
    is_old_rate,
    pin_fields,
    read_outputs,
)
from uav_ident_ros.import_logs.autopilot import Import
from uav_ident_ros.import_logs.dataflash import read_dataflash
from uav_ident_ros.import_logs.flight_log import Choice, FlightLog, ImportLogError
from uav_ident_ros.import_logs.knowledge import table
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.stamps import Stretches, intervals

RAW, FILTERED = "GYR", "IMU"

OLD_INSTANCES = ("IMU", "IMU2", "IMU3")
"""Types of the units before the messages had a field for it."""

EVENT_ARMED, EVENT_DISARMED = 10, 11
"""EV.Id, in logs without ARM messages."""

TYPES = {RAW, *OLD_INSTANCES, *PINS, *READERS, "ACC", "CTUN", "ARM", "EV", "STAT", "DSF"}
"""The messages that are read, beside the table's streams."""


def read_ardupilot(
    path: Path,  # Dataflash file
    choice: Choice,  # What to take in place of the best
) -> FlightLog:
    """Read an ArduPilot dataflash log.

    Raises
    ------
    ImportLogError
        If the file cannot be read, or has no rates or no actuators.
    """
    if choice.actuators_instance:
        raise ImportLogError(f"log '{path}': ArduPilot logs one set of actuators, instance 0")
    known = table("ardupilot")
    log = read_dataflash(path, TYPES | {t for types in known["streams"].values() for t in types})
    title = next((text for text in log.texts if _firmware(text)), "ArduPilot")
    firmware = _firmware(title)
    old = (rate := log.messages("RATE")) is not None and is_old_rate(rate)
    it = Import(log, known | _of_firmware(known, firmware, old=old), choice)
    it.refuse_others("firmware", firmware, "it calls itself")
    name_as_today(log, firmware)
    it.in_the_air(log.messages("STAT"), "isFlying", lambda flying: flying > 0)
    it.say_flight(_armed(log), "ARM, EV")
    readers = dict.fromkeys((RAW, FILTERED), _rates)
    rates = it.read_rates(readers, lambda name, unit: _gyro(log, name, unit))
    actuators = read_outputs(it)
    hovering = firmware == "Copter" or actuators[0] == "RATE"
    statistics = log.messages("DSF")
    if statistics is not None and "Dp" in statistics and statistics.columns["Dp"].max() > 0:
        lost = statistics.columns["Dp"].max()
        log.findings.doubt(f"the logger lost {lost:.0f} messages (DSF.Dp)")
    return it.flight_log(title, rates, actuators, hovers=hovering)


def _firmware(text: str) -> str:
    """Return which vehicle a firmware's name is of, as 'Copter' of 'APM:Copter V3.4'; or ''."""
    kinds = [*table("ardupilot")["aircraft"], *table("ardupilot")["not_aircraft"]["firmware"]]
    found = re.match(rf"(?:Ardu|APM:|Antenna)?({'|'.join(kinds)})\b.*\bV?\d", text)
    return found[1] if found else ""


def _of_firmware(known: dict[Any, Any], firmware: str, *, old: bool) -> dict[str, Any]:
    """Return what differs by the firmware: modes, logging options, unit of the rates asked for."""
    return {
        "modes": known["modes"].get(firmware, {}),
        "logging": known["logging"].get(firmware, {"parameter": "LOG_BITMASK", "options": []}),
        "setpoint_unit": np.pi / 180.0 * (0.01 if old else 1.0),  # before 3.4 hundredths of deg/s
    }


def _armed(log: Log) -> Stretches | None:
    """Stretches in which it was armed; None if the log does not say.

    What is logged is the change: before the first the state was the other.
    """
    for name, field in (("ARM", "ArmState"), ("EV", "Id")):
        messages = log.messages(name)
        if messages is None or field not in messages:
            continue
        t_ns, values = messages.stamp_ns, messages.columns[field]
        if name == "EV":
            known = np.isin(values, (EVENT_ARMED, EVENT_DISARMED))
            t_ns, values = t_ns[known], values[known] == EVENT_ARMED
        if len(t_ns):
            states = np.append(not values[0], values > 0)
            return intervals(np.append(log.start_ns or 0, t_ns), states, log.end_ns)
    return None


# --- rates --------------------------------------------------------------------------------------

Rates = tuple[TimeArray, FloatArray, FloatArray | None]


def _gyro(log: Log, name: str, unit: int) -> Messages | None:
    """Messages of one inertial unit that have rates, in new logs or old ones."""
    messages = log.messages(name, unit)
    if messages is None and name == FILTERED and unit < len(OLD_INSTANCES):
        messages = log.messages(OLD_INSTANCES[unit])
    return messages if messages and messages.has(*table("ardupilot")["gyro"]) else None


def _rates(it: Import, messages: Messages) -> Rates:
    """Rates in body axes, and the specific force from the same messages or others."""
    it.say_orientation("AHRS_ORIENTATION", "ArduPilot has turned IMU and GYR by it")
    names, unit = it.table["force"], it.choice.rates_instance
    own = names[FILTERED]
    force = messages.values(*own) if messages.has(*own) else it.force_at(messages, names, unit)
    return messages.sample_ns, messages.values(*it.table["gyro"]), force


RANGES = ("MIN", "TRIM", "MAX")
PAIRED = ("ELEVON_MIXING", "ELEVON_OUTPUT", "VTAIL_OUTPUT", "FLAPERON_OUTPUT", "MIXING_OUTPUT")
"""Old parameters of pairs of surfaces, whose senses have names no more."""

STICK = "RC3_"
"""The throttle's."""


def name_as_today(log: Log, firmware: str) -> None:
    """Add parameters to an old log, under today's names, as far as they follow from its own.

    Before Copter 3.5 and Plane 3.8 no parameter said what pins 1 to 4 of a plane or the motors'
    pins of a copter move: the firmware knew, from ``FRAME`` and the sticks' channels (``RCMAP_*``).
    Ranges and directions were those of the radio's channels, ``RCn_MIN, TRIM, MAX, REV``.
    """
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
