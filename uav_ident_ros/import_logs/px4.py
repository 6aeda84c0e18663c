# SPDX-License-Identifier: Apache-2.0
"""PX4 logs (`.ulg`): rates, commands, airspeed and what the log says of them.

Commands. Newer logs (v1.13 on, control allocation): `actuator_motors` and `actuator_servos`, whose
meaning is in the parameters ``CA_*``, and before the allocation `vehicle_torque_setpoint` and
`vehicle_thrust_setpoint`. Older ones (mixer files): `actuator_controls_0`, before the mixer,
and `actuator_outputs`, behind it.
"""

from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np

from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import (
    Actuators,
    ActuatorsReader,
    Import,
    RatesReader,
    table,
)
from uav_ident_ros.import_logs.channels import (
    PWM_MAX,
    PWM_MIN,
    demands,
    effect_of,
    effects_of_arms,
    named_once,
    over_range,
    rotor_effects,
)
from uav_ident_ros.import_logs.flight_log import (
    NO_EFFECT,
    Channel,
    Choice,
    FlightLog,
    Stream,
    rates_stream,
)
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.px4_log import read_folder, read_ulog
from uav_ident_ros.messages.types import PX4_ARMING_STATE_ARMED, PX4_RELATIVE_TIMESTAMP_INVALID

KNOWN = table("px4")
MULTIROTOR, FIXED_WING = 0, 1
"""CA_AIRFRAME."""

QUADROTOR = 2
"""MAV_TYPE."""

MOTOR_FUNCTION, SERVO_FUNCTION, FUNCTIONS_OF_A_KIND = 101, 201, 16
"""Output functions of the first motor and servo (PWM_MAIN_FUNCn), and how many there are."""

CONTROLS, OUTPUTS = "actuator_controls_", "actuator_outputs"
SETPOINTS = ("vehicle_torque_setpoint", "vehicle_thrust_setpoint")
ALLOCATED = {"actuator_motors": "CA_ROTOR_COUNT", "actuator_servos": "CA_SV_CS_COUNT"}
"""Topics behind the control allocation, and the parameters that say how many of them there are."""

LANDED = "vehicle_land_detected"

MOST_GYROS = 4


def read_px4(path: Path, choice: Choice) -> FlightLog:
    """Read a PX4 log: a ULog file, or a folder that ulog2csv has written.

    Raises
    ------
    ImportLogError
        If the file cannot be read, or has no rates or no actuators.
    """
    streams = {kind for kinds in KNOWN["streams"].values() for kind in kinds}
    topics = {*RATES_READERS, *COMMANDS, *streams, *KNOWN["force"], LANDED}
    log = (read_folder if path.is_dir() else read_ulog)(path, topics)
    it = Import(log, KNOWN, choice)
    for name in ("CA_AIRFRAME", "MAV_TYPE"):
        it.refuse_others(name, log.parameters.get(name), name)
    status = log.messages("vehicle_status")
    if status is not None and status.has("vehicle_type"):
        kind = int(status.columns["vehicle_type"][-1])
        it.refuse_others("vehicle_type", kind, "vehicle_status.vehicle_type")
    it.take_flight(
        it.stretches(LANDED, "landed", lambda landed: landed == 0),
        it.stretches("vehicle_status", "arming_state", lambda s: s == PX4_ARMING_STATE_ARMED),
    )
    rates = it.read_rates(RATES_READERS, log.messages, "sensor_gyro")
    hovering = _hovers(log, choice.actuators_instance)
    return it.flight_log(rates, _actuators(it), hovers=hovering)


def _from_sensor_combined(it: Import, topic: Messages) -> Stream:
    """Calibrated mean rates over each gyro period, in the body's axes."""
    _note_orientation(it, "PX4 has turned sensor_combined by it")
    relative = topic.columns["accelerometer_timestamp_relative"]
    valid = relative != PX4_RELATIVE_TIMESTAMP_INVALID
    force = None
    if not valid.any():
        it.findings.doubt("there is no valid accelerometer sample: ay and az are zero")
    else:
        last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), 0))
        force = topic.array("accelerometer_m_s2")[last]
        if not valid.all():
            it.findings.doubt(f"{int((~valid).sum())} accelerometer samples are invalid: held over")
        if offset := float(np.median(relative[valid])) * 1e-3:
            it.findings.note(f"accelerometer samples lie {offset:+.2f} ms from the gyro's")
    return rates_stream(topic.name, topic.stamp_ns, topic.array("gyro_rad"), force)


def _from_sensor_gyro(it: Import, topic: Messages) -> Stream:
    """Uncalibrated rates of one gyro, in the board's axes: offset and rotation applied here."""
    rates = topic.values(*"xyz")
    if not topic.has("timestamp_sample"):
        it.findings.assume(
            "sensor_gyro without timestamp_sample (before v1.11) is calibrated, filtered and "
            "turned into body axes by its driver"
        )
    else:
        number = int(it.log.parameter("SENS_BOARD_ROT"))
        listed = table("rotations").get(number)
        if listed is None:
            raise it.log.refusal(
                f": SENS_BOARD_ROT is {number}, which is not known: "
                "--rates-topic sensor_combined or vehicle_angular_velocity needs no rotation"
            )
        fine = rotation(*np.radians(_board_offsets(it.log)))
        rates = (rates - _gyro_offset(it.log, topic)) @ (fine @ rotation(*np.radians(listed))).T
        _note_orientation(it, "applied here to sensor_gyro, which is in the board's axes")
    return rates_stream(topic.name, topic.sample_ns, rates, it.force_at(topic))


def _from_angular_velocity(it: Import, topic: Messages) -> Stream:
    """Take the rates that PX4 controls with."""
    return rates_stream(topic.name, topic.sample_ns, topic.array("xyz"), it.force_at(topic))


RATES_READERS: dict[str, RatesReader] = {
    "sensor_combined": _from_sensor_combined,
    "sensor_gyro": _from_sensor_gyro,
    "vehicle_angular_velocity": _from_angular_velocity,
}
"""Readers by topic, the preferred first."""


def _board_offsets(log: Log) -> list[float]:
    """Return the fine roll, pitch, yaw of the board, deg."""
    return [log.parameter(f"SENS_BOARD_{axis}_OFF") for axis in "XYZ"]


def _note_orientation(it: Import, consequence: str) -> None:
    offsets = _board_offsets(it.log)
    fine = ", fine offsets {:.2f} {:.2f} {:.2f} deg".format(*offsets) if any(offsets) else ""
    it.note_orientation("SENS_BOARD_ROT", consequence, fine)


def _gyro_offset(log: Log, topic: Messages) -> FloatArray:
    """Calibrated offset of the gyro with this device number, rad/s, board axes."""
    device = int(topic.columns["device_id"][0]) if topic.has("device_id") else 0
    for i in range(MOST_GYROS):
        if device and int(log.parameter(f"CAL_GYRO{i}_ID")) == device:
            log.findings.note(f"gyro offset: CAL_GYRO{i}_XOFF, YOFF, ZOFF, subtracted")
            return np.array([log.parameter(f"CAL_GYRO{i}_{axis}OFF") for axis in "XYZ"])
    log.findings.assume("no CAL_GYROi_ID is this gyro's: its offset is taken as zero")
    return np.zeros(3)


# --- commands -----------------------------------------------------------------------------------


def _actuators(it: Import) -> Actuators:
    """Read the commands from the topic asked for, or from the best there is."""
    wanted = it.choice.actuators_topic

    def find(name: str, instance: int) -> Messages | None:
        if not name.startswith(CONTROLS):
            return it.log.messages(name, instance)
        # The sets of a VTOL of old are topics of their own.
        return it.log.messages(name) if wanted or name == f"{CONTROLS}{instance}" else None

    usable = it.find("actuators", READERS, find)
    name = _choose(it, usable)
    commands, channels = READERS[name](it, usable[name])
    it.findings.note(f"actuators: {commands.source}")
    if usable[name].has("timestamp_sample"):
        delays = usable[name].stamp_ns - usable[name].sample_ns
        it.findings.note(
            "commands count from their publication (timestamp), in the median "
            f"{np.median(delays) * 1e-6:.2f} ms after the gyro sample they answer "
            "(timestamp_sample)"
        )
    return commands, channels


def _choose(it: Import, usable: dict[str, Messages]) -> str:
    """Name the best topic: nearest to the actuators, of those that say what they move."""
    if sets := _sets_of_a_hybrid(it.log):
        it.findings.assume(
            f"a VTOL: {sets[0]} are the commands of hover, {sets[1]} those of forward flight "
            f"(--actuators-instance); {it.choice.actuators_instance} is taken"
        )
        if SETPOINTS[0] in sets[0] and SETPOINTS[0] in usable:
            return SETPOINTS[0]
    counts = {name: it.log.parameter(count) for name, count in ALLOCATED.items()}
    explained = {name: m for name, m in usable.items() if counts.get(name, 1.0) > 0}
    if not _pins_are_explained(it):
        explained.pop(OUTPUTS, None)
    streams = explained or dict(usable)
    if set(ALLOCATED) <= set(streams):  # they count as one: what is slower decides
        del streams[max(reversed(ALLOCATED), key=lambda name: streams[name].rate)]
    return it.choose(streams)


def _sets_of_a_hybrid(log: Log) -> tuple[str, str] | None:
    """Name the commands of a VTOL's hover and of its forward flight; None for any other."""
    if log.parameters.get("CA_AIRFRAME") in KNOWN["hybrid_airframes"]:
        return f"{SETPOINTS[0]} of instance 0", "of instance 1"
    if log.parameters.get("MAV_TYPE") in KNOWN["hybrid_types"]:
        return f"{CONTROLS}0", f"{CONTROLS}1"
    return None


def _hovers(log: Log, instance: int) -> bool:
    """Whether the commands are those of a multirotor: of one, or of a VTOL's hover."""
    if _sets_of_a_hybrid(log):
        return instance == 0
    airframe = log.parameters.get("CA_AIRFRAME")
    if airframe is not None:
        return airframe == MULTIROTOR
    return log.parameters.get("MAV_TYPE") in KNOWN["multirotor_types"]


# --- control allocation -----------------------------------------------------------------------


def _allocated(it: Import, _: Messages) -> Actuators:
    """Motors and servos behind the control allocation."""
    parts: list[Stream] = []
    channels: list[Channel] = []
    for name, describe in zip(ALLOCATED, (_motors, _servos), strict=True):
        if (topic := it.log.messages(name, it.choice.actuators_instance)) is not None:
            values = topic.array("control")
            in_use = np.flatnonzero(~np.isnan(values).all(axis=0))
            every = describe(it.log, values.shape[1])
            channels += [every[i] for i in in_use]
            parts.append(Stream(topic.name, topic.stamp_ns, values[:, in_use]))
    commands = reduce(Stream.joined, parts)
    if not channels:
        raise it.log.refusal(f": {commands.source} hold no value throughout: the motors were never "
                             "on")  # fmt: skip
    if not any(any(channel.effect) for channel in channels):
        raise it.log.refusal(
            f": no parameter (CA_ROTOR*, CA_SV_CS*) says what {commands.source} move; try "
            "--actuators-topic vehicle_torque_setpoint"
        )
    return commands, channels


def _motors(log: Log, count: int) -> list[Channel]:
    """Meaning of the entries of actuator_motors: first the rotors."""
    rotors = min(int(log.parameter("CA_ROTOR_COUNT")), count)
    airframe = log.parameters.get("CA_AIRFRAME")
    effects = [NO_EFFECT] * count
    if rotors and airframe == MULTIROTOR:

        def of_all(what: str, default: float = 0.0) -> list[float]:
            return [log.parameter(f"CA_ROTOR{i}_{what}", default) for i in range(rotors)]

        positions = np.column_stack([of_all("PX"), of_all("PY")])
        effects[:rotors] = rotor_effects(positions, of_all("KM", 0.05), of_all("CT", 6.5))
        log.findings.note(
            f"{rotors} rotors: positions, senses of rotation and thrusts from CA_ROTORi_PX, PY, "
            "KM, CT"
        )
        log.findings.assume(
            "thrust is taken as proportional to the command about its trim: a constant factor if "
            "THR_MDL_FAC is not"
        )
    elif rotors and airframe == FIXED_WING:
        effects[:rotors] = [(0.0, 0.0, 0.0, 1.0 / rotors)] * rotors
        log.findings.note(f"{rotors} motor(s) of a fixed wing (CA_AIRFRAME 1): dth is their mean")
    elif rotors:
        log.findings.assume(
            f"CA_AIRFRAME {airframe}: what the motors turn is not known here, they are only "
            "recorded"
        )
    return [Channel(f"motor_{i}", e, f"motor {i}, 0 to 1") for i, e in enumerate(effects, 1)]


def _servos(log: Log, count: int) -> list[Channel]:
    """Meaning of the entries of actuator_servos: first the control surfaces."""
    surfaces = min(int(log.parameter("CA_SV_CS_COUNT")), count)
    channels = []
    for i in range(surfaces):
        prefix = f"CA_SV_CS{i}_"
        kind = int(log.parameter(f"{prefix}TYPE"))
        torques = {
            a: log.parameter(f"{prefix}TRQ_{a[0].upper()}") for a in ("roll", "pitch", "yaw")
        }
        words = ", ".join(f"{axis} {torque:g}" for axis, torque in torques.items() if torque)
        effect = NO_EFFECT if kind in KNOWN["without_torque"] else effect_of(torques)
        name = KNOWN["surfaces"].get(kind, f"surface_type_{kind}")
        meaning = f"{prefix}TYPE {kind}, torques {words or 'none'}"
        channels.append(Channel(name, effect, meaning, neutral=log.parameter(f"{prefix}TRIM")))
    channels += [Channel(f"servo_{i + 1}", NO_EFFECT, "servo") for i in range(surfaces, count)]
    channels = named_once(channels)
    if surfaces:
        log.findings.note(
            f"{surfaces} control surfaces, types and torques from CA_SV_CSi_TYPE and _TRQ_R, _P, "
            f"_Y: {', '.join(channel.name for channel in channels[:surfaces])}"
        )
    return channels


# --- before the allocation, and behind the mixer ------------------------------------------------


def _setpoints(it: Import, torque: Messages) -> Actuators:
    """Torque and thrust asked of the control allocation."""
    commands, channels = demands(it, torque)
    thrust = it.log.messages(SETPOINTS[1], it.choice.actuators_instance)
    if thrust is None:
        it.findings.doubt("there is no vehicle_thrust_setpoint: dth is zero throughout")
        return commands, channels
    forces, axes = demands(it, thrust)
    acting = (0.0, 0.0, -1.0) if _lifts(it.log, forces.values) else (1.0, 0.0, 0.0)
    for axis, share in zip(axes, acting, strict=True):
        channels.append(replace(axis, effect=effect_of({"thrust": share})))
    return commands.joined(forces), channels


def _lifts(log: Log, forces: FloatArray) -> bool:
    """Whether the thrust that counts points up rather than forward."""
    airframe = log.parameters.get("CA_AIRFRAME")
    if airframe in (MULTIROTOR, FIXED_WING):
        return airframe == MULTIROTOR
    up, ahead = (float(np.nanmean(np.abs(forces[:, axis]))) for axis in (2, 0))
    log.findings.assume(f"dth is the {'upward' if up >= ahead else 'forward'} thrust: it is larger")
    return up >= ahead


def _pins(instance: int) -> str:
    """Return what the parameters of an instance of actuator_outputs begin with."""
    return "PWM_AUX" if instance else "PWM_MAIN"


def _pins_are_explained(it: Import) -> bool:
    """Whether parameters, or the one old mixer that is known, say what the pins move."""
    begin = f"{_pins(it.choice.actuators_instance)}_FUNC"
    return it.log.parameters.get("MAV_TYPE") == QUADROTOR or any(
        name.startswith(begin) and value for name, value in it.log.parameters.items()
    )


def _outputs(it: Import, topic: Messages) -> Actuators:
    """Pulse widths at the pins, with functions from PWM_*_FUNCn, or a quadrotor's old mixer."""
    log, instance = it.log, it.choice.actuators_instance
    values = topic.array("output")
    count = int(np.max(topic.columns["noutputs"])) or values.shape[1]
    prefix = _pins(instance)
    functions = [int(log.parameter(f"{prefix}_FUNC{i + 1}")) for i in range(count)]
    if any(functions):
        channels = _by_function(log, functions, prefix)
        log.findings.assume(f"instance {instance} of actuator_outputs are the pins {prefix}")
    elif log.parameters.get("MAV_TYPE") == QUADROTOR:
        channels = _quad_x(log, count)
    else:
        raise log.refusal(
            f": no parameter {prefix}_FUNCn says what the actuator_outputs move; "
            "try --actuators-topic actuator_controls_0"
        )
    return Stream(topic.name, topic.stamp_ns, values[:, :count]), channels


def _by_function(log: Log, functions: list[int], prefix: str) -> list[Channel]:
    motors = dict(enumerate(_motors(log, FUNCTIONS_OF_A_KIND), MOTOR_FUNCTION))
    servos = dict(enumerate(_servos(log, FUNCTIONS_OF_A_KIND), SERVO_FUNCTION))
    reversed_pins = int(log.parameter(f"{prefix}_REV"))
    channels = []
    for i, function in enumerate(functions):
        low = log.parameter(f"{prefix}_MIN{i + 1}", PWM_MIN)
        high = log.parameter(f"{prefix}_MAX{i + 1}", PWM_MAX)
        plain = Channel(f"output_{i + 1}", NO_EFFECT, "")
        channel = replace(
            {**motors, **servos}.get(function, plain),
            meaning=f"{prefix}_FUNC{i + 1} {function}",
            neutral=0.0,
            unit="us",
        )
        if channel.name != plain.name:
            centre = (low + high) / 2.0 if function in servos else None
            turned = bool(reversed_pins >> i & 1)
            channel = over_range(channel, low, high, centre=centre, turned=turned)
        channels.append(channel)
    return named_once(channels)


def _quad_x(log: Log, count: int) -> list[Channel]:
    """Take a quadrotor in X: the mixer file is not in an old log."""
    low, high = log.parameter("PWM_MIN", PWM_MIN), log.parameter("PWM_MAX", PWM_MAX)
    log.findings.assume(
        "a quadrotor in X with PX4's motor order (front right, rear left, front left, rear right) "
        "on outputs 1 to 4: MAV_TYPE is 2, the mixer file is not in the log"
    )
    log.findings.note(f"pulse widths from {low:g} to {high:g} us (PWM_MIN, PWM_MAX)")
    channels = [
        over_range(Channel(f"motor_{i}", effect, "output of quad x", unit="us"), low, high)
        for i, effect in enumerate(effects_of_arms(KNOWN["quad_x"]), 1)
    ]
    for i in range(len(channels) + 1, count + 1):
        channels.append(Channel(f"output_{i}", NO_EFFECT, "", unit="us"))
    return channels[:count]


READERS: dict[str, ActuatorsReader] = {
    **dict.fromkeys(ALLOCATED, _allocated),
    SETPOINTS[0]: _setpoints,
    f"{CONTROLS}0": demands,
    f"{CONTROLS}1": demands,
    OUTPUTS: _outputs,
}
"""Readers by topic, nearest to the actuators first; the pulse widths, whose meaning is the least
certain, last."""

COMMANDS = (*READERS, SETPOINTS[1])
"""Topics of commands."""
