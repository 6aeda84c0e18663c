# SPDX-License-Identifier: Apache-2.0
"""Which topic of a PX4 log tells what the actuators did, and what each channel means.

Newer logs (v1.13 on, control allocation): `actuator_motors` and `actuator_servos`, whose
meaning is in the parameters ``CA_*``, and before the allocation `vehicle_torque_setpoint` and
`vehicle_thrust_setpoint`. Older ones (mixer files): `actuator_controls_0`, before the mixer,
and `actuator_outputs`, behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import choose, find_messages
from uav_ident_ros.import_logs.flight_log import (
    NO_EFFECT,
    Actuators,
    Channel,
    Choice,
    Effect,
    Findings,
    ImportLogError,
    unique_names,
)
from uav_ident_ros.import_logs.knowledge import (
    effect_of,
    effects_of_arms,
    from_torques,
    rotor_effects,
    table,
)
from uav_ident_ros.import_logs.log import Log, Messages
from uav_ident_ros.import_logs.stamps import Stretches, join

KNOWN = table("px4")
MULTIROTOR, FIXED_WING = 0, 1
"""CA_AIRFRAME."""

MOTOR_FUNCTION, SERVO_FUNCTION = 101, 201
"""Output functions of the first motor and the first servo (PWM_MAIN_FUNCn)."""

FUNCTIONS_OF_A_KIND = 16
QUADROTOR = 2
"""MAV_TYPE of a quadrotor."""

PWM_MIN, PWM_MAX = 1000.0, 2000.0
"""Pulse widths of no and full command where no parameter says, us."""


BEFORE_MIXER = ("vehicle_torque_setpoint", "actuator_controls_0", "actuator_controls_1")


def read_actuators(log: Log, findings: Findings, choice: Choice, flight: Stretches) -> Actuators:
    """Read the commands from the topic asked for, or from the best there is.

    Raises
    ------
    ImportLogError
        If there is none, or the one asked for is missing or cannot be interpreted.
    """
    wanted, instance = choice.actuators_topic, choice.actuators_instance

    def find(name: str, instance: int) -> Messages | None:
        if not name.startswith(CONTROLS):
            return log.messages(name, instance)
        # The sets of a VTOL of old are topics of their own.
        return log.messages(name) if wanted or name == f"{CONTROLS}{instance}" else None

    usable = find_messages(log, "actuators", READERS, wanted, instance, find)
    name = _choose(log, usable, findings, flight, instance)
    actuators = READERS[name](log, findings, instance)
    findings.read.append(f"actuators: {actuators.source}")
    _say_delay(usable[name], findings)
    return actuators


CONTROLS = "actuator_controls_"


def _choose(
    log: Log, usable: dict[str, Messages], findings: Findings, flight: Stretches, instance: int
) -> str:
    """Name the best topic: nearest to the actuators, of those that say what they move."""
    parameters = log.parameters
    if parameters.get("CA_AIRFRAME") in KNOWN["hybrid_airframes"]:
        _say_hybrid("the setpoints of instance 0", "of instance 1", instance, findings)
        if SETPOINTS[0] in usable:
            return SETPOINTS[0]
    elif parameters.get("MAV_TYPE") in KNOWN["hybrid_types"]:
        _say_hybrid(f"{CONTROLS}0", f"{CONTROLS}1", instance, findings)
    explained = [n for n in usable if n not in ALLOCATED or _explained(log, n)]
    streams = {name: (usable[name].stamp_ns, usable[name].rate) for name in explained or usable}
    if set(ALLOCATED) <= set(streams):  # they count as one: what is slower decides
        del streams[max(reversed(ALLOCATED), key=lambda name: streams[name][1])]
    return choose(streams, flight, findings, "SDLOG_PROFILE: 'high rate'", BEFORE_MIXER)


def hovers(log: Log, instance: int) -> bool:
    """Whether the commands are those of a multirotor: of one, or of a VTOL's hover."""
    airframe, kind = log.parameters.get("CA_AIRFRAME"), log.parameters.get("MAV_TYPE")
    hybrid = airframe in KNOWN["hybrid_airframes"] or kind in KNOWN["hybrid_types"]
    if airframe is not None or hybrid:
        return airframe == MULTIROTOR or (hybrid and instance == 0)
    return kind in KNOWN["multirotor_types"]


def _say_hybrid(hover: str, forward: str, instance: int, findings: Findings) -> None:
    findings.assumed.append(
        f"a VTOL: {hover} are the commands of hover, {forward} those of forward flight "
        f"(--actuators-instance); {instance} is taken"
    )


SETPOINTS = ("vehicle_torque_setpoint", "vehicle_thrust_setpoint")
ALLOCATED = ("actuator_motors", "actuator_servos")


def _explained(log: Log, name: str) -> bool:
    """Whether the parameters say what the allocated actuators are."""
    count = "CA_ROTOR_COUNT" if name == "actuator_motors" else "CA_SV_CS_COUNT"
    return log.parameters.get(count, 0) > 0


def _say_delay(topic: Messages, findings: Findings) -> None:
    if "timestamp_sample" not in topic:
        return
    delay = float(np.median(topic.stamp_ns - topic.sample_ns)) * 1e-9
    findings.read.append(
        f"commands count from their publication (timestamp), in the median {delay * 1e3:.2f} ms "
        "after the gyro sample they answer (timestamp_sample)"
    )


# --- control allocation -----------------------------------------------------------------------


def _allocated(log: Log, findings: Findings, instance: int) -> Actuators:
    """Motors and servos behind the control allocation."""
    streams = []
    channels: list[Channel] = []
    sources = []
    for name, describe in (("actuator_motors", _motors), ("actuator_servos", _servos)):
        topic = log.messages(name, instance)
        if topic is None:
            continue
        values = topic.vector("control", topic.size("control"))
        in_use = ~np.isnan(values).all(axis=0)
        every = describe(log, findings, values.shape[1])
        channels += [c for c, used in zip(every, in_use, strict=True) if used]
        streams.append((topic.stamp_ns, values[:, in_use]))
        sources.append(topic.name)
    if not channels:
        raise ImportLogError(
            f"log '{log.path}': {' and '.join(sources)} hold no value throughout: the motors were "
            "never on"
        )
    t_ns, values = streams[0] if len(streams) == 1 else join(streams[0], streams[1])
    if not any(any(c.effect) for c in channels):
        raise ImportLogError(
            f"log '{log.path}': no parameter (CA_ROTOR*, CA_SV_CS*) says what "
            f"{' and '.join(sources)} move; try --actuators-topic vehicle_torque_setpoint"
        )
    return Actuators(" and ".join(sources), t_ns, values, tuple(channels))


def _motors(log: Log, findings: Findings, count: int) -> list[Channel]:
    """Meaning of the entries of actuator_motors."""
    get = log.parameters.get
    rotors = min(int(get("CA_ROTOR_COUNT", 0)), count)
    airframe = get("CA_AIRFRAME")
    effects: list[Effect] = [NO_EFFECT] * count
    if rotors and airframe == MULTIROTOR:
        positions = np.array([[_rotor(log, i, "PX"), _rotor(log, i, "PY")] for i in range(rotors)])
        moments = [_rotor(log, i, "KM", 0.05) for i in range(rotors)]
        thrusts = [_rotor(log, i, "CT", 6.5) for i in range(rotors)]
        effects[:rotors] = rotor_effects(positions, moments, thrusts)
        findings.read.append(
            f"{rotors} rotors: positions, senses of rotation and thrusts from CA_ROTORi_PX, PY, "
            "KM, CT"
        )
        findings.assumed.append(
            "thrust is taken as proportional to the command about its trim: a constant factor if "
            "THR_MDL_FAC is not"
        )
    elif rotors and airframe == FIXED_WING:
        effects[:rotors] = [(0.0, 0.0, 0.0, 1.0 / rotors)] * rotors
        findings.read.append(
            f"{rotors} motor(s) of a fixed wing (CA_AIRFRAME 1): dth is their mean"
        )
    elif rotors:
        findings.assumed.append(
            f"CA_AIRFRAME {airframe}: what the motors turn is not known here, they are only "
            "recorded"
        )
    return [
        Channel(f"motor_{i + 1}", effect, f"motor {i + 1}, 0 to 1")
        for i, effect in enumerate(effects)
    ]


def _rotor(log: Log, index: int, what: str, default: float = 0.0) -> float:
    return float(log.parameters.get(f"CA_ROTOR{index}_{what}", default))


def _servos(log: Log, findings: Findings, count: int) -> list[Channel]:
    """Meaning of the entries of actuator_servos: first the control surfaces."""
    get = log.parameters.get
    surfaces = min(int(get("CA_SV_CS_COUNT", 0)), count)
    types = [int(get(f"CA_SV_CS{i}_TYPE", 0)) for i in range(surfaces)]
    names = [KNOWN["surfaces"].get(kind, f"surface_type_{kind}") for kind in types]
    names += [f"servo_{i + 1}" for i in range(surfaces, count)]
    channels = []
    for i, name in enumerate(unique_names(names)):
        torques = [float(get(f"CA_SV_CS{i}_TRQ_{axis}", 0.0)) for axis in "RPY"]
        turns = i < surfaces and types[i] not in KNOWN["without_torque"]
        trim = float(get(f"CA_SV_CS{i}_TRIM", 0.0)) if i < surfaces else 0.0
        words = ", ".join(
            f"{a} {t:g}" for a, t in zip(("roll", "pitch", "yaw"), torques, strict=True) if t
        )
        meaning = (
            f"CA_SV_CS{i}_TYPE {types[i]}, torques {words or 'none'}" if i < surfaces else "servo"
        )
        effect = from_torques(torques[0], torques[1], torques[2]) if turns else NO_EFFECT
        channels.append(Channel(name, effect, meaning, neutral=trim))
    if surfaces:
        findings.read.append(
            f"{surfaces} control surfaces, types and torques from CA_SV_CSi_TYPE and _TRQ_R, _P, "
            f"_Y: {', '.join(names[:surfaces])}"
        )
    return channels


# --- before the allocation or the mixer ---------------------------------------------------------


def _setpoints(log: Log, findings: Findings, instance: int) -> Actuators:
    """Torque and thrust asked of the control allocation."""
    torque = log.messages("vehicle_torque_setpoint", instance)
    thrust = log.messages("vehicle_thrust_setpoint", instance)
    if torque is None:
        raise ImportLogError(
            f"log '{log.path}' has no vehicle_torque_setpoint of instance {instance}"
        )
    channels = [
        Channel("roll_torque", from_torques(1.0, 0.0, 0.0), "torque setpoint, right positive"),
        Channel("pitch_torque", from_torques(0.0, 1.0, 0.0), "torque setpoint, up positive"),
        Channel("yaw_torque", from_torques(0.0, 0.0, 1.0), "torque setpoint, right positive"),
    ]
    findings.assumed.append(
        "the allocation delivers the torques asked for: setpoints know no saturation"
    )
    stream = (torque.stamp_ns, torque.vector("xyz"))
    if thrust is None:
        findings.lost.append("there is no vehicle_thrust_setpoint: dth is zero throughout")
        return Actuators(torque.name, *stream, tuple(channels))
    forces = thrust.vector("xyz")
    upward = _lifts(log, forces, findings)
    channels += [
        Channel("thrust_x", NO_EFFECT if upward else (0.0, 0.0, 0.0, 1.0), "thrust forward"),
        Channel("thrust_y", NO_EFFECT, "thrust right"),
        Channel("thrust_z", (0.0, 0.0, 0.0, -1.0) if upward else NO_EFFECT, "thrust down"),
    ]
    t_ns, values = join(stream, (thrust.stamp_ns, forces))
    return Actuators(f"{torque.name} and {thrust.name}", t_ns, values, tuple(channels))


def _lifts(log: Log, forces: FloatArray, findings: Findings) -> bool:
    """Whether the thrust that counts points up rather than forward."""
    airframe = log.parameters.get("CA_AIRFRAME")
    if airframe in (MULTIROTOR, FIXED_WING):
        return airframe == MULTIROTOR
    up, ahead = (float(np.nanmean(np.abs(forces[:, axis]))) for axis in (2, 0))
    findings.assumed.append(
        f"dth is the {'upward' if up >= ahead else 'forward'} thrust: it is larger"
    )
    return up >= ahead


def _controls(name: str, log: Log, findings: Findings, instance: int) -> Actuators:
    """One set of controls of logs before v1.13 or so."""
    topic = log.messages(name)
    assert topic is not None  # the caller has looked
    values = topic.vector("control", topic.size("control"))
    channels = tuple(
        Channel(entry["name"], effect_of(entry), f"{topic.name}, index {i}, before the mixer")
        for i, entry in enumerate(KNOWN["control_group"][: values.shape[1]])
    )
    findings.read.append(
        "controls 0 to 3 are roll, pitch, yaw (-1 to 1, right, up, right positive) and thrust (0 "
        "to 1)"
    )
    findings.assumed.append(
        "the mixer delivers what it is asked for: its file is not in the log, and controls know no "
        "saturation"
    )
    return Actuators(topic.name, topic.stamp_ns, values, channels)


# --- pulse widths -------------------------------------------------------------------------------


def _outputs(log: Log, findings: Findings, instance: int) -> Actuators:
    """Pulse widths at the pins, with functions from PWM_*_FUNCn, or a quadrotor's old mixer."""
    topic = log.messages("actuator_outputs", instance)
    assert topic is not None  # the caller has looked
    count = int(np.max(topic.columns["noutputs"])) or topic.size("output")
    values = topic.vector("output", topic.size("output"))[:, :count]
    prefix = "PWM_AUX" if instance else "PWM_MAIN"
    functions = [int(log.parameters.get(f"{prefix}_FUNC{i + 1}", 0)) for i in range(count)]
    if any(functions):
        channels = _by_function(log, findings, functions, prefix)
        findings.assumed.append(f"instance {instance} of actuator_outputs are the pins {prefix}")
    elif log.parameters.get("MAV_TYPE") == QUADROTOR:
        channels = _quad_x(log, findings, count)
    else:
        raise ImportLogError(
            f"log '{log.path}': no parameter {prefix}_FUNCn says what the actuator_outputs move; "
            "try --actuators-topic actuator_controls_0"
        )
    return Actuators(topic.name, topic.stamp_ns, values, tuple(channels))


def _by_function(log: Log, findings: Findings, functions: list[int], prefix: str) -> list[Channel]:
    """Meaning of pins whose functions are parameters."""
    motors = _motors(log, findings, FUNCTIONS_OF_A_KIND)
    servos = _servos(log, findings, FUNCTIONS_OF_A_KIND)
    reversed_pins = int(log.parameters.get(f"{prefix}_REV", 0))
    channels = []
    for i, function in enumerate(functions):
        low = float(log.parameters.get(f"{prefix}_MIN{i + 1}", PWM_MIN))
        high = float(log.parameters.get(f"{prefix}_MAX{i + 1}", PWM_MAX))
        sign = -1.0 if reversed_pins >> i & 1 else 1.0
        where = f"{prefix}_FUNC{i + 1} {function}, {low:g} to {high:g} us"
        if MOTOR_FUNCTION <= function < MOTOR_FUNCTION + FUNCTIONS_OF_A_KIND:
            kind, scale = motors[function - MOTOR_FUNCTION], sign / (high - low)
            neutral = low if sign > 0 else high
        elif SERVO_FUNCTION <= function < SERVO_FUNCTION + FUNCTIONS_OF_A_KIND:
            kind, scale = servos[function - SERVO_FUNCTION], 2.0 * sign / (high - low)
            neutral = (low + high) / 2.0
        else:
            kind, scale, neutral = Channel(f"output_{i + 1}", NO_EFFECT, ""), 1.0, 0.0
        channels.append(replace(kind, meaning=where, scale=scale, neutral=neutral, unit="us"))
    names = unique_names([channel.name for channel in channels])
    return [replace(c, name=name) for c, name in zip(channels, names, strict=True)]


def _quad_x(log: Log, findings: Findings, count: int) -> list[Channel]:
    """Take a quadrotor in X: the mixer file is not in an old log."""
    low = float(log.parameters.get("PWM_MIN", PWM_MIN))
    high = float(log.parameters.get("PWM_MAX", PWM_MAX))
    effects = effects_of_arms(KNOWN["quad_x"])
    findings.assumed.append(
        "a quadrotor in X with PX4's motor order (front right, rear left, front left, rear right) "
        "on outputs 1 to 4: MAV_TYPE is 2, the mixer file is not in the log"
    )
    findings.read.append(f"pulse widths from {low:g} to {high:g} us (PWM_MIN, PWM_MAX)")
    return [
        Channel(f"motor_{i + 1}", effects[i], "output of quad x", 1.0 / (high - low), low, "us")
        if i < len(effects)
        else Channel(f"output_{i + 1}", NO_EFFECT, "not a motor", unit="us")
        for i in range(count)
    ]


READERS: dict[str, Callable[[Log, Findings, int], Actuators]] = {
    "actuator_motors": _allocated,
    "actuator_servos": _allocated,
    "vehicle_torque_setpoint": _setpoints,
    "actuator_controls_0": partial(_controls, "actuator_controls_0"),
    "actuator_controls_1": partial(_controls, "actuator_controls_1"),
    "actuator_outputs": _outputs,
}
"""Readers by topic, nearest to the actuators first; the pulse widths, whose meaning is the least
certain, last."""

COMMANDS = (*READERS, "vehicle_thrust_setpoint")
"""Topics of commands."""
