# SPDX-License-Identifier: Apache-2.0
"""ArduPilot dataflash logs (`.bin`): rates, outputs, airspeed and what the log says of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.ardupilot_outputs import PINS, READERS, read_outputs
from uav_ident_ros.import_logs.dataflash import DataflashLog, Messages
from uav_ident_ros.import_logs.flight_log import (
    Airspeed,
    Choice,
    Findings,
    FlightLog,
    ImportLogError,
    Rates,
)
from uav_ident_ros.import_logs.orientation import describe_rotation
from uav_ident_ros.import_logs.stamps import hold, interpolate, intervals

ENOUGH_RATE = 20.0
"""Slowest rates the identifier works with, Hz."""

RAW, FILTERED = "GYR", "IMU"
RATES_TYPES = (RAW, FILTERED)
OLD_INSTANCES = {"IMU2": 1, "IMU3": 2}
"""Types of the second and third unit before the messages had a field for it."""

EVENT_ARMED, EVENT_DISARMED = 10, 11
"""EV.Id, in logs without ARM messages."""

FLIGHT_STATES = (
    ("in the air", "STAT", "isFlying"),
    ("armed", "ARM", "ArmState"),
    ("armed", "EV", "Id"),
)
"""What tells of flight: the state in words, message and field, the best first."""

EXPLAINING = ("SERVO", "FRAME_", "AHRS_ORIENTATION", "INS_GYR", "INS_POS", "MOT_PWM_")
"""First letters of the parameters that an import is based on."""

TYPES = (
    *RATES_TYPES,
    *OLD_INSTANCES,
    *PINS,
    *READERS,
    *("ACC", "ARSP", "CTUN", "ARM", "EV", "STAT", "DSF"),
)
"""The messages that are read."""

GYRO_FIELDS, FORCE_FIELDS = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")


def read_ardupilot(path: Path, choice: Choice) -> FlightLog:
    """Read an ArduPilot dataflash log.

    Parameters
    ----------
    path : Path
        Dataflash file.
    choice : Choice
        What to take in place of the best.

    Raises
    ------
    ImportLogError
        If the file cannot be read, or has no rates or no actuators.
    """
    if choice.actuators_instance:
        raise ImportLogError(f"log '{path}': ArduPilot logs one set of actuators, instance 0")
    log = DataflashLog(path, tuple(dict.fromkeys(TYPES)))
    findings = Findings(lost=list(log.damage))
    unit = choice.rates_instance
    rates = _read_rates(log, findings, choice.rates_topic, unit)
    actuators = read_outputs(log, findings, choice.actuators_topic)
    flown = _flown(log, findings)
    lever_arm = _lever_arm(log, findings, unit)
    airspeed = _airspeed(log, findings)
    for t, name, value in log.changes:
        if name.startswith(EXPLAINING):
            findings.lost.append(f"{name} became {value:g} at {t:.1f} s: the first value is used")
    _say_dropouts(log, findings)
    findings.read.append("stamps are the autopilot's time since its start, not the time of day")
    title = next((text for text in log.texts if text.startswith("Ardu")), "ArduPilot")
    return FlightLog(path, title, rates, actuators, findings, airspeed, lever_arm, flown)


# --- rates --------------------------------------------------------------------------------------


def _read_rates(log: DataflashLog, findings: Findings, wanted: str | None, unit: int) -> Rates:
    """Read the raw gyro if it was logged, else the filtered one."""
    if wanted is not None and wanted not in RATES_TYPES:
        raise ImportLogError(
            f"log '{log.path}': '{wanted}' are no messages of rates: there are "
            f"{', '.join(RATES_TYPES)}"
        )
    found = {name: _of_unit(log, name, unit) for name in ([wanted] if wanted else RATES_TYPES)}
    usable = {
        n: m for n, m in found.items() if m is not None and set(GYRO_FIELDS) <= set(m.columns)
    }
    if not usable:
        raise ImportLogError(
            f"log '{log.path}' has no gyro ({', '.join(found)}, unit {unit}); it has "
            f"{log.contents()}"
        )
    fast = [name for name, messages in usable.items() if messages.rate >= ENOUGH_RATE]
    name = fast[0] if fast else max(usable, key=lambda n: usable[n].rate)
    messages = usable[name]
    if not fast:
        findings.lost.append(
            f"{name} has {messages.rate:.3g} Hz only: {ENOUGH_RATE:g} Hz are needed (LOG_BITMASK)"
        )
    _say_rates(log, messages, name, findings)
    others = [f"{n} at {m.rate:.4g} Hz" for n, m in usable.items() if n != name]
    units = log.instances(name)
    if others or len(units) > 1:
        findings.read.append(
            f"other rates in the log, not used: {', '.join(others) or 'none'}; units {units} of "
            f"{name}"
        )
    force = _force(log, messages, unit, findings)
    return Rates(messages.name, messages.sample_ns, messages.values(*GYRO_FIELDS), force)


def _of_unit(log: DataflashLog, name: str, unit: int) -> Messages | None:
    """Messages of one inertial unit, in new logs or old ones."""
    old = [n for n, number in OLD_INSTANCES.items() if number == unit and name == FILTERED]
    return log.messages(name, unit) or (log.messages(old[0]) if old else None)


def _say_rates(log: DataflashLog, messages: Messages, name: str, findings: Findings) -> None:
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


def _force(log: DataflashLog, rates: Messages, unit: int, findings: Findings) -> FloatArray | None:
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
    findings.lost.append("there is no accelerometer at a useful rate: ay and az are zero")
    return None


# --- the rest -----------------------------------------------------------------------------------


def _lever_arm(log: DataflashLog, findings: Findings, unit: int) -> tuple[float, float, float]:
    x, y, z = (float(log.parameters.get(f"INS_POS{unit + 1}_{axis}", 0.0)) for axis in "XYZ")
    if any((x, y, z)):
        findings.read.append(f"accelerometer at {x:g} {y:g} {z:g} m (INS_POS{unit + 1}_X, Y, Z)")
    else:
        findings.assumed.append(
            f"the accelerometer is at the centre of gravity (INS_POS{unit + 1}_* 0)"
        )
    return x, y, z


def _airspeed(log: DataflashLog, findings: Findings) -> Airspeed | None:
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


def _flown(log: DataflashLog, findings: Findings) -> list[tuple[int, int]] | None:
    """Stretches in the air (Plane) or armed; None if the log says neither."""
    sources = (
        ("in the air", "STAT", "isFlying"),
        ("armed", "ARM", "ArmState"),
        ("armed", "EV", "Id"),
    )
    for state, name, field in sources:
        messages = log.messages(name)
        if messages is None or field not in messages:
            continue
        t_ns, values = messages.stamp_ns, messages.columns[field]
        if name == "EV":
            known = np.isin(values, (EVENT_ARMED, EVENT_DISARMED))
            t_ns, values = t_ns[known], values[known] == EVENT_ARMED
        if not len(t_ns):
            continue
        stretches = intervals(t_ns, values > 0, log.end_ns)
        if not stretches:
            findings.lost.append(f"the vehicle was never {state} ({name}.{field})")
            return []
        seconds = sum(end - start for start, end in stretches) * 1e-9
        findings.read.append(
            f"{state} for {seconds:.1f} s in {len(stretches)} stretch(es) ({name}.{field})"
        )
        return stretches
    findings.assumed.append("the log does not say when it flew: all of it counts as flight")
    return None


def _say_dropouts(log: DataflashLog, findings: Findings) -> None:
    """Say what the logger itself lost."""
    statistics = log.messages("DSF")
    if statistics is not None and "Dp" in statistics and statistics.columns["Dp"].max() > 0:
        findings.lost.append(
            f"the logger lost {statistics.columns['Dp'].max():.0f} messages (DSF.Dp)"
        )
