# SPDX-License-Identifier: Apache-2.0
"""PX4 logs (`.ulg`): rates, actuator commands, airspeed, parameters.

Commands from v1.13 on (control allocation) are `actuator_motors` and `actuator_servos`, with
effects from the parameters ``CA_*``, and before the allocation `vehicle_torque_setpoint` and
`vehicle_thrust_setpoint`. Those of older logs (mixer files) are `actuator_controls_0`, before the
mixer, and `actuator_outputs`, behind it.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np

from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.autopilot import Actuators, Import, Usable, kinds, table
from uav_ident_ros.import_logs.flight_log import (
    NO_EFFECT,
    PWM_MAX,
    PWM_MIN,
    Channel,
    Choice,
    FlightLog,
    effect_of,
    effects_of_arms,
    named_once,
    rotor_effects,
)
from uav_ident_ros.import_logs.log import Log, LogStream, Messages
from uav_ident_ros.import_logs.px4_log import read_folder, read_ulog
from uav_ident_ros.messages.types import PX4_RELATIVE_TIMESTAMP_INVALID

KNOWN = table("px4")
MULTIROTOR, FIXED_WING = 0, 1
"""CA_AIRFRAME."""

QUADROTOR_FRAME = 2
"""MAV_TYPE."""

MOTOR_FUNCTION, SERVO_FUNCTION, FUNCTIONS_OF_A_KIND = 101, 201, 16
"""Output functions of the first motor and servo (PWM_MAIN_FUNCn), and the number of each."""

MOST_PINS = 16
PINS = ("PWM_MAIN", "PWM_AUX")
"""First letters of the parameters of each instance of actuator_outputs."""

CONTROLS, OUTPUTS = "actuator_controls_", "actuator_outputs"
SETPOINTS = ("vehicle_torque_setpoint", "vehicle_thrust_setpoint")
ALLOCATED = {"actuator_motors": "CA_ROTOR_COUNT", "actuator_servos": "CA_SV_CS_COUNT"}
"""Topics behind the control allocation, and the parameters with the number of their channels."""

MOST_GYROS = 4


def read_px4(path: Path, choice: Choice) -> FlightLog:
    """Read a PX4 log: a ULog file, or a folder of tables from ulog2csv."""
    topics = kinds(KNOWN) | {*ALLOCATED, OUTPUTS}
    log = (read_folder if path.is_dir() else read_ulog)(path, topics)
    it = _Px4(log, KNOWN, choice)
    status = log.messages("vehicle_status")
    kind = status.columns.get("vehicle_type", [None])[-1] if status else None
    it.refuse_others(log.parameters | {"vehicle_status.vehicle_type": kind})
    return it.flight_log()


class _Px4(Import):
    """Import of a PX4 log: raw gyros, and the commands of three generations of firmware."""

    # --- rates ------------------------------------------------------------------------------------

    def turn(self, kind: str, messages: Messages, measured: FloatArray) -> None:
        if kind == "sensor_combined":
            measured[:, 3:] = self._valid_force(messages, measured[:, 3:])
        elif kind == "sensor_gyro":
            measured[:, :3] = self._calibrated(messages, measured[:, :3])

    def _valid_force(self, combined: Messages, force: FloatArray) -> FloatArray | float:
        """Return the specific force of sensor_combined; invalid samples hold the last valid one."""
        relative = combined.columns["accelerometer_timestamp_relative"]
        valid = relative != PX4_RELATIVE_TIMESTAMP_INVALID
        if np.isnan(force).all() or not valid.any():
            self.findings.lost.append("there is no valid accelerometer sample: ay and az are zero")
            return np.nan
        if not valid.all():
            self.findings.lost.append(
                f"{int((~valid).sum())} accelerometer samples are invalid: held over"
            )
        last = np.maximum.accumulate(np.where(valid, np.arange(len(valid)), 0))
        return np.asarray(force[last])

    def _calibrated(self, gyro: Messages, rates: FloatArray) -> FloatArray:
        """Return the rates of sensor_gyro without offset, turned from board to body axes."""
        if not gyro.has("timestamp_sample"):
            self.findings.assumed.append(
                "sensor_gyro without timestamp_sample (before v1.11) is calibrated, filtered and "
                "turned into body axes by its driver"
            )
            return rates
        turned = self.note_orientation("applied here to sensor_gyro, which is in the board's axes")
        if turned is None:
            number = self.log.parameter("SENS_BOARD_ROT")
            raise self.log.refusal(
                f": SENS_BOARD_ROT is {number:.0f}, which is not known: --rates-topic "
                "sensor_combined or vehicle_angular_velocity needs no rotation"
            )
        fine = [self.log.parameter(name) for name in KNOWN["orientation"]["fine"]]
        board = rotation(*np.radians(fine)) @ rotation(*np.radians(turned))
        return np.asarray((rates - self._gyro_offset(gyro)) @ board.T)

    def _gyro_offset(self, gyro: Messages) -> FloatArray:
        """Return the calibrated offset of the gyro with this device number, rad/s, board axes."""
        device = int(gyro.columns["device_id"][0]) if gyro.has("device_id") else 0
        for i in range(MOST_GYROS):
            if device and int(self.log.parameter(f"CAL_GYRO{i}_ID")) == device:
                self.findings.read.append(f"gyro offset: CAL_GYRO{i}_XOFF, YOFF, ZOFF, subtracted")
                return np.array([self.log.parameter(f"CAL_GYRO{i}_{axis}OFF") for axis in "XYZ"])
        self.findings.assumed.append("no CAL_GYROi_ID is this gyro's: its offset is taken as zero")
        return np.zeros(3)

    # --- commands ---------------------------------------------------------------------------------

    def readers(self) -> Mapping[str, Callable[[Messages], Actuators]]:
        # Pulse widths come last: their effects are the least certain.
        return {
            **dict.fromkeys(ALLOCATED, self._allocated),
            SETPOINTS[0]: self._setpoints,
            f"{CONTROLS}0": self.demands,
            f"{CONTROLS}1": self.demands,
            OUTPUTS: self._outputs,
        }

    def messages(self, name: str, instance: int) -> Messages | None:
        if not name.startswith(CONTROLS):
            return self.log.messages(name, instance)
        # The sets of a VTOL before v1.13 are separate topics.
        wanted = self.choice.actuators_topic or f"{CONTROLS}{instance}"
        return self.log.messages(name) if name == wanted else None

    def explained(self, usable: Usable) -> Usable:
        if (sets := _sets_of_a_vtol(self.log)) is not None:
            self.findings.assumed.append(
                f"a VTOL: {sets[0]} are the commands of hover, {sets[1]} those of forward flight "
                f"(--actuators-instance); {self.choice.actuators_instance} is taken"
            )
            if sets[0].startswith(SETPOINTS[0]) and SETPOINTS[0] in usable:
                return {SETPOINTS[0]: usable[SETPOINTS[0]]}
        counts = {name: self.log.parameter(count) for name, count in ALLOCATED.items()}
        explained = {name: m for name, m in usable.items() if counts.get(name, 1.0) > 0}
        if not any(self._functions()) and self.log.parameters.get("MAV_TYPE") != QUADROTOR_FRAME:
            explained.pop(OUTPUTS, None)
        streams = explained or dict(usable)
        if set(ALLOCATED) <= set(streams):  # they count as one, at the rate of the slower
            del streams[max(reversed(ALLOCATED), key=lambda name: streams[name].rate)]
        return streams

    def hovers(self, commands: LogStream) -> bool:
        if _sets_of_a_vtol(self.log) is not None:
            return self.choice.actuators_instance == 0
        parameter = "CA_AIRFRAME" if "CA_AIRFRAME" in self.log.parameters else "MAV_TYPE"
        return self.log.parameters.get(parameter) in KNOWN["multirotors"][parameter]

    def _allocated(self, _: Messages) -> Actuators:
        """Read the commands of motors and servos, behind the control allocation."""
        parts: list[LogStream] = []
        channels: list[Channel] = []
        for name, describe in zip(ALLOCATED, (_motors, _servos), strict=True):
            if (topic := self.log.messages(name, self.choice.actuators_instance)) is not None:
                values = topic.array("control")
                in_use = np.flatnonzero(~np.isnan(values).all(axis=0))
                every = describe(self.log, values.shape[1])
                channels += [every[i] for i in in_use]
                parts.append(LogStream(topic.name, topic.stamp_ns, values[:, in_use]))
        commands = reduce(LogStream.joined, parts)
        if not channels:
            raise self.log.refusal(
                f": {commands.source} hold no value throughout: the motors were never on"
            )
        return commands, channels

    def _setpoints(self, torque: Messages) -> Actuators:
        """Read the torque and thrust setpoints, before the control allocation."""
        commands, channels = self.demands(torque)
        thrust = self.log.messages(SETPOINTS[1], self.choice.actuators_instance)
        if thrust is None or np.isnan(thrust.array("xyz")).all():
            self.findings.lost.append(f"there is no {SETPOINTS[1]}: dth is zero throughout")
            return commands, channels
        forces, axes = self.demands(thrust)
        acting = (0.0, 0.0, -1.0) if _lifts(self.log, forces.values) else (1.0, 0.0, 0.0)
        for axis, share in zip(axes, acting, strict=True):
            channels.append(replace(axis, effect=effect_of({"thrust": share})))
        return commands.joined(forces), channels

    def _pins(self) -> str:
        """Return the first letters of the parameters of an instance of actuator_outputs."""
        return PINS[min(self.choice.actuators_instance, 1)]

    def _functions(self) -> list[int]:
        """Return the functions of all pins of an instance of actuator_outputs."""
        pins = range(1, MOST_PINS + 1)
        return [int(self.log.parameter(f"{self._pins()}_FUNC{pin}")) for pin in pins]

    def _outputs(self, topic: Messages) -> Actuators:
        """Read the pulse widths, with functions from PWM_*_FUNCn or a quadrotor's old mixer."""
        log, prefix, functions = self.log, self._pins(), self._functions()
        values, meaning = topic.array("output"), f"{prefix}_FUNC{{}} {{}}"
        count = min(int(np.max(topic.columns["noutputs"])) or MOST_PINS, values.shape[1])
        if any(functions):
            known = dict(enumerate(_motors(log, FUNCTIONS_OF_A_KIND), MOTOR_FUNCTION))
            known |= dict(enumerate(_servos(log, FUNCTIONS_OF_A_KIND), SERVO_FUNCTION))
            instance = self.choice.actuators_instance
            log.findings.assumed.append(
                f"instance {instance} of actuator_outputs are the pins {prefix}"
            )
        elif log.parameters.get("MAV_TYPE") == QUADROTOR_FRAME:
            effects, meaning = effects_of_arms(KNOWN["quad_x"]), "output of quad x"
            motors = [Channel(f"motor_{i}", effect, meaning) for i, effect in enumerate(effects, 1)]
            known = dict(enumerate(motors, MOTOR_FUNCTION))
            functions = [*range(MOTOR_FUNCTION, MOTOR_FUNCTION + MOST_PINS)]
            log.findings.assumed.append(
                "a quadrotor in X with PX4's motor order (front right, rear left, front left, rear "
                "right) on outputs 1 to 4: MAV_TYPE is 2, the mixer file is not in the log"
            )
        else:
            raise log.refusal(
                f": no parameter {prefix}_FUNCn says what the actuator_outputs move; "
                "try --actuators-topic actuator_controls_0"
            )
        channels = []
        for pin, function in enumerate(functions[:count], 1):
            channel = Channel(f"output_{pin}", NO_EFFECT, meaning.format(pin, function), unit="us")
            if moved := known.get(function):
                channel = replace(channel, name=moved.name, effect=moved.effect)
                low, high = self._width(pin, "MIN", PWM_MIN), self._width(pin, "MAX", PWM_MAX)
                centre = (low + high) / 2.0 if function >= SERVO_FUNCTION else None
                bit = int(log.parameter(f"{prefix}_REV")) >> (pin - 1) & 1
                turned = bool(bit or log.parameter(f"{prefix}_REV{pin}"))
                channel = channel.over_range(low, high, centre=centre, turned=turned)
            channels.append(channel)
        return LogStream(topic.name, topic.stamp_ns, values[:, :count]), named_once(channels)

    def _width(self, pin: int, end: str, usual: float) -> float:
        """Return an end of a pin's range: its own, or that of its group (v1.12) or of all pins."""
        prefix = self._pins()
        names = (f"{prefix}_{end}{pin}", f"{prefix}_{end}", f"PWM_{end}")
        widths = (self.log.parameter(name, -1.0) for name in names)  # -1: not set
        return next((width for width in widths if width >= 0.0), usual)


# --- meaning of the parameters --------------------------------------------------------------------


def _sets_of_a_vtol(log: Log) -> tuple[str, str] | None:
    """Return the names of a VTOL's commands in hover and in forward flight; None if no VTOL."""
    if log.parameters.get("CA_AIRFRAME") in KNOWN["vtols"]["CA_AIRFRAME"]:
        return f"{SETPOINTS[0]} of instance 0", "of instance 1"
    if log.parameters.get("MAV_TYPE") in KNOWN["vtols"]["MAV_TYPE"]:
        return f"{CONTROLS}0", f"{CONTROLS}1"
    return None


def _lifts(log: Log, forces: FloatArray) -> bool:
    """Return whether dth is the upward thrust; it is the forward thrust otherwise."""
    airframe = log.parameters.get("CA_AIRFRAME")
    if airframe in (MULTIROTOR, FIXED_WING):
        return airframe == MULTIROTOR
    ahead, _, up = np.nansum(np.abs(forces), axis=0)
    log.findings.assumed.append(
        f"dth is the {'upward' if up >= ahead else 'forward'} thrust: it is larger"
    )
    return bool(up >= ahead)


def _motors(log: Log, count: int) -> list[Channel]:
    """Return the channels of actuator_motors; the rotors come first."""
    rotors = min(int(log.parameter("CA_ROTOR_COUNT")), count)
    airframe = log.parameters.get("CA_AIRFRAME")
    effects = [NO_EFFECT] * count
    if rotors and airframe == MULTIROTOR:

        def of_all(what: str, default: float = 0.0) -> list[float]:
            return [log.parameter(f"CA_ROTOR{i}_{what}", default) for i in range(rotors)]

        positions = np.column_stack([of_all("PX"), of_all("PY")])
        effects[:rotors] = rotor_effects(positions, of_all("KM", 0.05), of_all("CT", 6.5))
        log.findings.read.append(
            f"{rotors} rotors: positions, senses of rotation and thrusts from CA_ROTORi_PX, PY, "
            "KM, CT"
        )
        log.findings.assumed.append(
            "thrust is taken as proportional to the command about its trim: a constant factor if "
            "THR_MDL_FAC is not"
        )
    elif rotors and airframe == FIXED_WING:
        effects[:rotors] = [(0.0, 0.0, 0.0, 1.0 / rotors)] * rotors
    elif rotors:
        log.findings.assumed.append(
            f"CA_AIRFRAME {airframe}: what the motors turn is not known here, they are only "
            "recorded"
        )
    return [Channel(f"motor_{i}", e, f"motor {i}, 0 to 1") for i, e in enumerate(effects, 1)]


def _servos(log: Log, count: int) -> list[Channel]:
    """Return the channels of actuator_servos; the control surfaces come first."""
    surfaces = min(int(log.parameter("CA_SV_CS_COUNT")), count)
    channels = []
    for i in range(surfaces):
        prefix = f"CA_SV_CS{i}_"
        kind = int(log.parameter(f"{prefix}TYPE"))
        torques = {
            a: log.parameter(f"{prefix}TRQ_{a[0].upper()}") for a in ("roll", "pitch", "yaw")
        }
        nonzero = ", ".join(f"{axis} {torque:g}" for axis, torque in torques.items() if torque)
        effect = NO_EFFECT if kind in KNOWN["without_torque"] else effect_of(torques)
        name = KNOWN["surfaces"].get(kind, f"surface_type_{kind}")
        meaning = f"{prefix}TYPE {kind}, torques {nonzero or 'none'}"
        channels.append(Channel(name, effect, meaning, neutral=log.parameter(f"{prefix}TRIM")))
    channels += [Channel(f"servo_{i + 1}", NO_EFFECT, "servo") for i in range(surfaces, count)]
    channels = named_once(channels)
    if surfaces:
        log.findings.read.append(
            f"{surfaces} control surfaces, types and torques from CA_SV_CSi_TYPE and _TRQ_R, _P, "
            f"_Y: {', '.join(channel.name for channel in channels[:surfaces])}"
        )
    return channels
