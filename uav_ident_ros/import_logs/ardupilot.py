# SPDX-License-Identifier: Apache-2.0
"""ArduPilot dataflash logs (`.bin`): rates, outputs, airspeed and what the log says of them."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.import_logs.ardupilot_outputs import PINS, READERS, name_as_today, read_outputs
from uav_ident_ros.import_logs.autopilot import Import, table
from uav_ident_ros.import_logs.dataflash import read_dataflash
from uav_ident_ros.import_logs.flight_log import (
    Choice,
    FlightLog,
    ImportLogError,
    Stream,
    rates_stream,
)
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.stamps import Stretches, intervals

RAW, FILTERED = "GYR", "IMU"

OLD_INSTANCES = ("IMU", "IMU2", "IMU3")
"""Types of the units before the messages had a field for it."""

EVENT_ARMED, EVENT_DISARMED = 10, 11
"""EV.Id, in logs without ARM messages."""

NORMALISED = 10.0
"""Demands beyond this are in the units before Copter 3.4, thousands: none is above one since."""

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
    log.title = next((text for text in log.texts if _firmware(text)), "ArduPilot")
    firmware = _firmware(log.title)
    it = Import(log, known | _of_firmware(log, firmware), choice)
    it.refuse_others("firmware", firmware, "it calls itself")
    name_as_today(log, firmware)
    it.take_flight("STAT", "isFlying", lambda flying: flying > 0, _armed(log), "ARM, EV")
    readers = dict.fromkeys((RAW, FILTERED), _rates)
    rates = it.read_rates(readers, lambda name, unit: _gyro(log, name, unit))
    actuators = read_outputs(it)
    statistics = log.messages("DSF")
    lost = statistics.columns["Dp"].max() if statistics and statistics.has("Dp") else 0
    if lost:
        log.findings.doubt(f"the logger lost {lost:.0f} messages (DSF.Dp)")
    hovering = firmware == "Copter" or actuators[0].source == "RATE"
    return it.flight_log(rates, actuators, hovers=hovering)


def _firmware(text: str) -> str:
    """Return which vehicle a firmware's name is of, as 'Copter' of 'APM:Copter V3.4'; or ''."""
    kinds = [*table("ardupilot")["aircraft"], *table("ardupilot")["not_aircraft"]["firmware"]]
    found = re.match(rf"(?:Ardu|APM:|Antenna)?({'|'.join(kinds)})\b.*\bV?\d", text)
    return found[1] if found else ""


def _of_firmware(log: Log, firmware: str) -> dict[str, Any]:
    """Return what differs by the firmware: modes, logging options, units."""
    known, rate = table("ardupilot"), log.messages("RATE")
    result = {
        "modes": known["modes"].get(firmware, {}),
        "logging": known["logging"].get(firmware, {"parameter": "LOG_BITMASK", "options": []}),
        "setpoint_unit": np.radians(known["setpoint_unit"]),
    }
    controls = [rate.columns[f] for f in known["controls"]["RATE"] if rate and rate.has(f)]
    if any(np.abs(asked[np.isfinite(asked)]).max(initial=0.0) > NORMALISED for asked in controls):
        old = known["old_units"]
        result["setpoint_unit"] *= old["setpoint_unit"]
        result |= {key: known[key] | old[key] for key in ("controls", "said")}
    return result


def _armed(log: Log) -> Stretches | None:
    """Stretches in which it was armed; None if the log does not say.

    What is logged is the change: before the first the state was the other.
    """
    for name, field in (("ARM", "ArmState"), ("EV", "Id")):
        messages = log.messages(name)
        if messages is None or not messages.has(field):
            continue
        t_ns, values = messages.stamp_ns, messages.columns[field]
        if name == "EV":
            known = np.isin(values, (EVENT_ARMED, EVENT_DISARMED))
            t_ns, values = t_ns[known], values[known] == EVENT_ARMED
        if len(t_ns):
            states = np.append(not values[0], values > 0)
            return intervals(np.append(log.start_ns or 0, t_ns), states, log.end_ns)
    return None


def _gyro(log: Log, name: str, unit: int) -> Messages | None:
    """Messages of one inertial unit that have rates, in new logs or old ones."""
    messages = log.messages(name, unit)
    if messages is None and name == FILTERED and unit < len(OLD_INSTANCES):
        messages = log.messages(OLD_INSTANCES[unit])
    return messages if messages and messages.has(*table("ardupilot")["gyro"]) else None


def _rates(it: Import, messages: Messages) -> Stream:
    """Rates in body axes, and the specific force from the same messages or others."""
    it.say_orientation("AHRS_ORIENTATION", "ArduPilot has turned IMU and GYR by it")
    own = it.table["force"][FILTERED]
    force = messages.values(*own) if messages.has(*own) else None
    if force is None:
        force = it.force_at(messages, it.choice.rates_instance)
    rates = messages.values(*it.table["gyro"])
    return rates_stream(messages.name, messages.sample_ns, rates, force)
