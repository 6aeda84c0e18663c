# SPDX-License-Identifier: Apache-2.0
"""ArduPilot dataflash logs (`.bin`): rates, outputs, airspeed and what the log says of them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.ardupilot_names import name_as_today
from uav_ident_ros.import_logs.ardupilot_outputs import PINS, READERS, is_old_rate, read_outputs
from uav_ident_ros.import_logs.autopilot import (
    BOOT_TIME,
    ENOUGH_RATE,
    NO_FORCE,
    choose,
    find_messages,
    median_in_flight,
    read_lever_arm,
    read_mode,
    read_setpoint,
    refuse_others,
    say_changes,
    say_instances,
    say_stretches,
    that_explain,
)
from uav_ident_ros.import_logs.dataflash import read_dataflash
from uav_ident_ros.import_logs.flight_log import (
    Airspeed,
    Attitude,
    Choice,
    Findings,
    FlightLog,
    ImportLogError,
    Rates,
    Setpoint,
)
from uav_ident_ros.import_logs.knowledge import describe_rotation, quaternions, table
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.stamps import Stretches, hold, interpolate, intervals

RAW, FILTERED = "GYR", "IMU"
RATES_TYPES = (RAW, FILTERED)
OLD_INSTANCES = {"IMU2": 1, "IMU3": 2}
"""Types of the second and third unit before the messages had a field for it."""

EVENT_ARMED, EVENT_DISARMED = 10, 11
"""EV.Id, in logs without ARM messages."""

IMPORTED = ("SERVO", "FRAME_", "AHRS_ORIENTATION", "INS_GYR", "INS_POS", "MOT_PWM_")
"""First letters of the parameters that an import is based on."""

EXPLAINING = (*IMPORTED, "INS_", "ATC_RAT_", "RLL", "PTCH", "YAW", "LOG_", "SCHED_LOOP")
"""... and of those that matter to what comes of it: filters, gains, what is logged."""

RATES_ASKED_FOR = ("RDes", "PDes", "YDes")
"""deg/s."""

EULER = ("Roll", "Pitch", "Yaw")

TYPES = (
    *RATES_TYPES,
    *OLD_INSTANCES,
    *PINS,
    *READERS,
    *("ACC", "ARSP", "CTUN", "ARM", "EV", "STAT", "DSF", "ATT", "GPS", "MODE"),
)
"""The messages that are read."""

GYRO_FIELDS, FORCE_FIELDS = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")


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
    log = read_dataflash(path, TYPES)
    findings = Findings(lost=list(log.remarks), damage=list(log.damage))
    unit = choice.rates_instance
    title = next((text for text in log.texts if _firmware(text)), "ArduPilot")
    refuse_others(log, table("ardupilot")["not_aircraft"], _firmware(title), "it calls itself")
    name_as_today(log, _firmware(title), findings)
    armed = _armed(log)
    flown = _flown(log, armed, findings)
    rates = _read_rates(log, findings, choice.rates_topic, unit, flown or [])
    actuators = read_outputs(log, findings, choice.actuators_topic, flown or [])
    lever_arm = read_lever_arm(log.parameters, f"INS_POS{unit + 1}_", findings)
    airspeed = _airspeed(log, findings)
    say_changes(log, IMPORTED, findings)
    _say_dropouts(log, findings)
    findings.read.append(BOOT_TIME)
    return FlightLog(
        path,
        title,
        rates,
        actuators,
        findings,
        airspeed,
        lever_arm,
        flown,
        armed,
        _attitude(log, findings),
        _setpoint(log, findings),
        read_mode(log.messages("MODE"), "Mode", _modes(_firmware(title)), findings),
        _firmware(title) == "Copter" or actuators.source == "RATE",
        _ground_speed(log, flown or []),
        that_explain(log.parameters, EXPLAINING),
    )


# --- rates --------------------------------------------------------------------------------------


def _firmware(text: str) -> str:
    """Return which vehicle a firmware's name is of, as 'Copter' of 'APM:Copter V3.4'; or ''."""
    kinds = [*table("ardupilot")["aircraft"], *table("ardupilot")["not_aircraft"]]
    found = re.match(rf"(?:Ardu|APM:|Antenna)?({'|'.join(kinds)})\b.*\bV?\d", text)
    return found[1] if found else ""


def _read_rates(
    log: Log, findings: Findings, wanted: str | None, unit: int, flight: Stretches
) -> Rates:
    """Read the raw gyro if it was logged, else the filtered one."""

    def find(name: str, unit: int) -> Messages | None:
        messages = _of_unit(log, name, unit)
        return messages if messages and set(GYRO_FIELDS) <= set(messages.columns) else None

    usable = find_messages(log, "rates", RATES_TYPES, wanted, unit, find)
    streams = {name: (messages.sample_ns, messages.rate) for name, messages in usable.items()}
    name = choose(streams, flight, findings, "LOG_BITMASK")
    messages = usable[name]
    _say_rates(log, messages, name, findings)
    say_instances(name, log.instances(name), findings)
    force = _force(log, messages, unit, findings)
    return Rates(messages.name, messages.sample_ns, messages.values(*GYRO_FIELDS), force)


def _of_unit(log: Log, name: str, unit: int) -> Messages | None:
    """Messages of one inertial unit, in new logs or old ones."""
    old = [n for n, number in OLD_INSTANCES.items() if number == unit and name == FILTERED]
    return log.messages(name, unit) or (log.messages(old[0]) if old else None)


def _say_rates(log: Log, messages: Messages, name: str, findings: Findings) -> None:
    if name == RAW:
        findings.read.append(
            f"rates: {messages.name}, raw samples stamped when sampled (SampleUS), in body axes "
            "forward-right-down"
        )
        findings.assumed.append(
            "GYR is from before the filters: INS_RAW_LOG_OPT can ask for the filtered rates instead"
        )
    else:
        cutoff = log.parameters.get("INS_GYRO_FILTER")
        findings.read.append(f"rates: {messages.name}, in body axes forward-right-down")
        findings.lost.append(
            "IMU is low-passed"
            + (f" at {cutoff:g} Hz (INS_GYRO_FILTER)" if cutoff else "")
            + " by ArduPilot: it comes late, which counts as a further delay of the inputs. Raw "
            "rates (GYR) are logged if LOG_BITMASK asks for raw IMU"
        )
    number = log.parameters.get("AHRS_ORIENTATION")
    if number is None:
        findings.assumed.append(
            "the log has no AHRS_ORIENTATION; ArduPilot logs in body axes anyway"
        )
    else:
        findings.read.append(
            f"board orientation: AHRS_ORIENTATION {number:g}, {describe_rotation(int(number))}; "
            "ArduPilot has turned IMU and GYR by it"
        )


def _force(log: Log, rates: Messages, unit: int, findings: Findings) -> FloatArray | None:
    """Specific force at the stamps of the rates, from the same messages or others."""
    if set(FORCE_FIELDS) <= set(rates.columns):
        return rates.values(*FORCE_FIELDS)
    for name in ("ACC", FILTERED):
        messages = _of_unit(log, name, unit)
        if messages is not None and messages.rate >= ENOUGH_RATE:
            findings.read.append(
                f"specific force: {messages.name}, interpolated to the rates' stamps"
            )
            return interpolate(rates.sample_ns, messages.sample_ns, messages.values(*FORCE_FIELDS))
    findings.lost.append(NO_FORCE)
    return None


# --- the rest -----------------------------------------------------------------------------------


def _airspeed(log: Log, findings: Findings) -> Airspeed | None:
    """Airspeed of the first sensor, made true by Plane's ratio if that was logged."""
    messages = log.messages("ARSP")
    if messages is None or "Airspeed" not in messages:
        return None
    speed = messages.columns["Airspeed"].astype(float)
    tuning = log.messages("CTUN")
    if tuning is not None and "E2T" in tuning:
        ratio = hold(messages.stamp_ns, tuning.stamp_ns, tuning.values("E2T"))[:, 0]
        speed = speed * np.where(np.isfinite(ratio), ratio, 1.0)
        findings.read.append("true airspeed: ARSP.Airspeed times CTUN.E2T")
    else:
        findings.assumed.append("ARSP.Airspeed is indicated; without CTUN.E2T it is taken as true")
    return Airspeed("ARSP", messages.stamp_ns, speed)


def _attitude(log: Log, findings: Findings) -> Attitude | None:
    """Find ArduPilot's estimate of the attitude."""
    messages = log.messages("ATT")
    if messages is None or not set(EULER) <= set(messages.columns):
        return None
    findings.read.append("attitude: ATT, as the Imu's orientation (FRD to NED)")
    roll, pitch, yaw = np.radians(messages.values(*EULER)).T
    return Attitude("ATT", messages.stamp_ns, quaternions(roll, pitch, yaw))


def _setpoint(log: Log, findings: Findings) -> Setpoint | None:
    """Find the rates that Copter or a QuadPlane asked for; before 3.4 in hundredths of deg/s."""
    messages = log.messages("RATE")
    old = messages is not None and is_old_rate(messages)
    unit = np.pi / 180.0 * (0.01 if old else 1.0)
    return read_setpoint(messages, RATES_ASKED_FOR, unit, findings)


def _modes(firmware: str) -> dict[int, str]:
    """Return the names of the modes of a firmware, by their numbers."""
    named: dict[int, str] = table("ardupilot")["modes"].get(firmware, {})
    return named


def _ground_speed(log: Log, flight: Stretches) -> float:
    """Return the median speed over ground in flight, m/s; 0 if it is not known."""
    messages = log.messages("GPS")
    if messages is None or "Spd" not in messages:
        return 0.0
    return median_in_flight(messages.stamp_ns, messages.values("Spd")[:, 0], flight)


def _armed(log: Log) -> list[tuple[int, int]] | None:
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
            before = not values[0]
            return intervals(
                np.append(log.start_ns or 0, t_ns), np.append(before, values > 0), log.end_ns
            )
    return None


def _flown(
    log: Log, armed: list[tuple[int, int]] | None, findings: Findings
) -> list[tuple[int, int]] | None:
    """Stretches in the air (Plane) or armed; None if the log says neither."""
    state, source, stretches = "armed", "ARM, EV", armed
    flying = log.messages("STAT")
    if flying is not None and "isFlying" in flying:
        state, source = "in the air", "STAT.isFlying"
        stretches = intervals(flying.stamp_ns, flying.columns["isFlying"] > 0, log.end_ns)
    if stretches is None:
        findings.assumed.append("the log does not say when it flew: all of it counts as flight")
    elif not stretches:
        findings.lost.append(f"the vehicle was never {state} ({source})")
    else:
        say_stretches(state, source, stretches, findings)
    return stretches


def _say_dropouts(log: Log, findings: Findings) -> None:
    """Say what the logger itself lost."""
    statistics = log.messages("DSF")
    if statistics is not None and "Dp" in statistics and statistics.columns["Dp"].max() > 0:
        findings.lost.append(
            f"the logger lost {statistics.columns['Dp'].max():.0f} messages (DSF.Dp)"
        )
