# SPDX-License-Identifier: Apache-2.0
"""Supported message types, and their conversion to plain values.

A type is an entry of `RATE_ADAPTERS`, `ACTUATOR_ADAPTERS`, `AIRSPEED_READERS` or `ARMED_READERS`,
which makes it a choice of the setting ``imu.type``, ``actuators.type``, ``airspeed.type`` or
``armed.type``.

The adapters use attribute access only: rclpy messages, rosbags messages and stand-ins all work.
Only `import_type` imports ROS.
"""

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from uav_ident_ros.identification.samples import NS_PER_S as NS_PER_S
from uav_ident_ros.identification.settings import (
    ACTUATOR_TYPES,
    AIRSPEED_TYPES,
    ARMED_TYPES,
    RATE_TYPES,
    ActuatorSettings,
    ImuSettings,
    nearest,
)
from uav_ident_ros.identification.structure import INPUTS

NS_PER_US = 1_000

Vector = tuple[float, float, float]


NOT_FINITE, NOT_DECODABLE = "not finite", "not decodable"
"""Reasons to refuse a message: NaN or infinite values, bytes that are no message of its type."""

MOST_LISTED, LONGEST_NAME = 30, 120
"""Most names in an error message, and characters of each: more would flood the log."""


class MessageTypeError(Exception):
    """A message type or field is unknown or not installed; the message names it."""


class ChannelError(ValueError):
    """A message contradicts the settings; the text gives the problem."""

    def __init__(self, message: str, reason: str = "wrong channels") -> None:
        super().__init__(message)
        self.reason = reason  # Key of the count of refused messages


class RatesReading(NamedTuple):
    """One message of the rates topic."""

    stamp_ns: int  # Message time, ns
    # (3,) Angular velocity, rad/s, in the sensor's axes; None if an Imu declares none
    rates: Vector | None
    # (3,) Specific force, m/s^2, in the sensor's axes; None if the type or message has none
    specific_force: Vector | None
    frame_id: str  # Frame of the header; empty if the type has none


@dataclass(frozen=True)
class RatesAdapter:
    """Reader of one type of rates message."""

    read: Callable[[Any], RatesReading]
    # Whether its axes are forward-right-down by definition; otherwise `imu.convention` gives them
    frd: bool = False


Stamp = Callable[[Any], int]
"""Time of a message, ns."""


@dataclass(frozen=True)
class ActuatorAdapter:
    """Layout of one type of actuator message."""

    stamp: Stamp | None  # None if the type has no stamp; the time of arrival counts
    # Array fields for the channels; the first is the default
    fields: tuple[str, ...]
    unit: str = "as its publisher defines"  # Unit of the values, in words
    named: bool = False  # Whether messages name their channels
    count: str = ""  # Field with the number of array entries in use; empty if all are


# --- reading ---------------------------------------------------------------------------------


def stamp_ns(stamp: Any) -> int:
    """Return a builtin_interfaces/Time in ns."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def header_ns(message: Any) -> int:
    """Return the stamp of the message's std_msgs/Header, ns."""
    return stamp_ns(message.header.stamp)


def px4_ns(message: Any) -> int:
    """Return the sample time of a PX4 message, or else its time of publication, ns."""
    return int(getattr(message, "timestamp_sample", 0) or message.timestamp) * NS_PER_US


def _read_imu(message: Any) -> RatesReading:
    # sensor_msgs/Imu: a covariance that starts with -1 means that there is no such measurement.
    rates = force = None
    if message.angular_velocity_covariance[0] != -1.0:
        rates = xyz(message.angular_velocity)
    if message.linear_acceleration_covariance[0] != -1.0:
        force = xyz(message.linear_acceleration)
    return RatesReading(header_ns(message), rates, force, message.header.frame_id)


def xyz(vector: Any) -> Vector:
    """Return a geometry_msgs/Vector3."""
    return float(vector.x), float(vector.y), float(vector.z)


def _three(values: Any) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


PX4_RELATIVE_TIMESTAMP_INVALID = 0x7FFFFFFF
"""SensorCombined: value for no accelerometer sample."""


def _read_px4_sensor_combined(message: Any) -> RatesReading:
    force = None
    if message.accelerometer_timestamp_relative != PX4_RELATIVE_TIMESTAMP_INVALID:
        force = _three(message.accelerometer_m_s2)
    return RatesReading(px4_ns(message), _three(message.gyro_rad), force, "")


_NORMALISED = "normalised, -1 to 1"

RATE_ADAPTERS: dict[str, RatesAdapter] = RATE_TYPES
RATE_ADAPTERS |= {
    "sensor_msgs/msg/Imu": RatesAdapter(_read_imu),
    "px4_msgs/msg/VehicleAngularVelocity": RatesAdapter(
        lambda m: RatesReading(px4_ns(m), _three(m.xyz), None, ""), frd=True
    ),
    "px4_msgs/msg/SensorCombined": RatesAdapter(_read_px4_sensor_combined, frd=True),
}
"""The supported types of the rates topic."""

ACTUATOR_ADAPTERS: dict[str, ActuatorAdapter] = ACTUATOR_TYPES
ACTUATOR_ADAPTERS |= {
    "std_msgs/msg/Float64MultiArray": ActuatorAdapter(None, ("data",)),
    "std_msgs/msg/Float32MultiArray": ActuatorAdapter(None, ("data",)),
    "sensor_msgs/msg/JointState": ActuatorAdapter(
        header_ns, ("position", "velocity", "effort"), "rad, rad/s or Nm", named=True
    ),
    "actuator_msgs/msg/Actuators": ActuatorAdapter(
        header_ns, ("position", "velocity", "normalized"), "rad, rad/s or -1 to 1"
    ),
    "mavros_msgs/msg/RCOut": ActuatorAdapter(header_ns, ("channels",), "pulse width, microseconds"),
    "mavros_msgs/msg/ActuatorControl": ActuatorAdapter(header_ns, ("controls",), _NORMALISED),
    "px4_msgs/msg/ActuatorMotors": ActuatorAdapter(px4_ns, ("control",), _NORMALISED),
    "px4_msgs/msg/ActuatorServos": ActuatorAdapter(px4_ns, ("control",), _NORMALISED),
    "px4_msgs/msg/ActuatorOutputs": ActuatorAdapter(
        px4_ns, ("output",), "the output's own, mostly microseconds", count="noutputs"
    ),
}
"""The supported types of the actuator topic."""

Reading = tuple[int | None, Any]
"""Stamp, ns (None if the type has none: the time of arrival counts), and values."""

PX4_ARMING_STATE_ARMED = 2
"""VehicleStatus: the value of `arming_state` while armed."""


def _plain(stamp: Stamp | None, value: Callable[[Any], Any]) -> Callable[[Any], Reading]:
    return lambda message: (stamp(message) if stamp else None, value(message))


AIRSPEED_READERS: dict[str, Callable[[Any], Reading]] = AIRSPEED_TYPES
AIRSPEED_READERS |= {
    "std_msgs/msg/Float64": _plain(None, lambda m: float(m.data)),
    "std_msgs/msg/Float32": _plain(None, lambda m: float(m.data)),
    "geometry_msgs/msg/TwistStamped": _plain(header_ns, lambda m: math.hypot(*xyz(m.twist.linear))),
    "mavros_msgs/msg/VfrHud": _plain(header_ns, lambda m: float(m.airspeed)),
    "px4_msgs/msg/AirspeedValidated": _plain(px4_ns, lambda m: float(m.true_airspeed_m_s)),
}
"""The supported types of the airspeed topic: true airspeed, m/s; NaN while none is valid."""

ARMED_READERS: dict[str, Callable[[Any], Reading]] = ARMED_TYPES
ARMED_READERS |= {
    "std_msgs/msg/Bool": _plain(None, lambda m: bool(m.data)),
    "mavros_msgs/msg/State": _plain(header_ns, lambda m: bool(m.armed)),
    "px4_msgs/msg/VehicleStatus": _plain(
        px4_ns, lambda m: int(m.arming_state) == PX4_ARMING_STATE_ARMED
    ),
    "px4_msgs/msg/ActuatorArmed": _plain(px4_ns, lambda m: bool(m.armed)),
}
"""The supported types of the armed topic: whether the motors are armed."""

EXCITATION_TYPE = "sensor_msgs/msg/JointState"


def read_excitation(message: Any) -> tuple[int, tuple[float, ...]]:
    """Return stamp, ns, and de, dr, da, dth; 0 for inputs that are not in the message.

    Raises
    ------
    ChannelError
        If it has another name, or a name without a value.
    """
    names, positions = list(message.name), list(message.position)
    unknown = [name for name in names if name not in INPUTS]
    if unknown or len(names) != len(positions) or not names:
        raise ChannelError(
            f"names {listed(names)} with {len(positions)} positions: some of "
            f"{', '.join(INPUTS)} are wanted, each with a position"
        )
    by_name = dict(zip(names, positions, strict=True))
    return header_ns(message), tuple(float(by_name.get(name, 0.0)) for name in INPUTS)


class ActuatorReader:
    """Reader of the configured channels in actuator messages.

    Raises
    ------
    MessageTypeError
        If the type has no such array field, or channels are named and the type names none.
    """

    def __init__(self, settings: ActuatorSettings) -> None:
        self._adapter = adapter = ACTUATOR_ADAPTERS[settings.type]
        self.field = settings.field or adapter.fields[0]  # The array field that is read
        if self.field not in adapter.fields:
            raise MessageTypeError(
                f"'actuators.field' is '{settings.field}': {settings.type} has "
                f"{', '.join(adapter.fields)}"
            )
        self._channels = settings.channels
        self._named = isinstance(settings.channels[0], str)
        self._indices = [] if self._named else [int(channel) for channel in settings.channels]
        self._names: list[str] | None = None  # of the newest message
        if self._named and not adapter.named:
            raise MessageTypeError(
                f"'actuators.channels' are names, but {settings.type} names no channels: "
                "write their indices, from 0"
            )

    def __call__(self, message: Any) -> tuple[int | None, tuple[float, ...]]:
        """Return (stamp in ns or None, the N channels in the configured order).

        Raises
        ------
        ChannelError
            If a channel is missing or not finite.
        """
        adapter, values = self._adapter, getattr(message, self.field)
        if self._named and message.name != self._names:
            self._find(list(message.name))
        if adapter.count:
            values = values[: int(getattr(message, adapter.count))]
        try:
            selected = tuple([float(values[i]) for i in self._indices])
        except IndexError:
            raise ChannelError(
                f"'{self.field}' has {len(values)} values, too few for channels "
                f"{listed(self._channels)}"
            ) from None
        if not math.isfinite(sum(selected)):  # a sum of finite channels does not overflow
            raise ChannelError(
                f"channels {listed(self._channels)} are {listed(selected)}: not all finite",
                NOT_FINITE,
            )
        return adapter.stamp(message) if adapter.stamp else None, selected

    def _find(self, names: list[str]) -> None:
        """Find the configured channels among the `names` of a message."""
        indices = []
        for channel in map(str, self._channels):
            if channel not in names:
                hint = f"; {meant}" if (meant := nearest(channel, names)) else ""
                found = f" among {listed(names)}" if names else ": the message names none"
                raise ChannelError(f"there is no channel '{channel}'{found}{hint}")
            indices.append(names.index(channel))
        self._indices, self._names = indices, names


def listed(items: Sequence[object], nothing: str = "none") -> str:
    """Return names in one line, within the limits `MOST_LISTED` and `LONGEST_NAME`."""
    names = [f"{item}" for item in items[:MOST_LISTED]]
    shown = [name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}..." for name in names]
    more = f" and {len(items) - MOST_LISTED} more" if len(items) > MOST_LISTED else ""
    return (", ".join(shown) or nothing) + more


FLU_TO_FRD = (1.0, -1.0, -1.0)
"""Factors of x, y, z for half a turn about x, which is its own inverse."""

FRAME_IDS = {"flu": "base_link", "frd": "base_link_frd"}
"""frame_id of an Imu by the convention of its axes (REP-103, REP-147)."""


class RatesReader:
    """Reader of rates messages; it compares their axes with the settings."""

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._read = RATE_ADAPTERS[settings.type].read
        self.frame_id: str | None = None  # Frame of the newest message; None before the first
        # Contradiction between axes and settings; empty if none
        self.fault = frame_fault(settings.convention, "", settings.type)

    def __call__(self, message: Any) -> Reading:
        """Return stamp, ns, and the pair of rates and specific force; it also takes a reading.

        Raises
        ------
        ChannelError
            If it holds no rates, or the axes contradict the settings.
        """
        reading = message if isinstance(message, RatesReading) else self._read(message)
        if reading.frame_id != self.frame_id:
            self.frame_id = reading.frame_id
            self.fault = frame_fault(
                self._settings.convention, reading.frame_id, self._settings.type
            )
        if self.fault:
            raise ChannelError(self.fault, "wrong frame")
        if reading.rates is None:
            raise ChannelError("angular_velocity_covariance[0] is -1: no rates in it", "no rates")
        return reading.stamp_ns, (reading.rates, reading.specific_force)


def frame_fault(convention: str, frame_id: str, msgtype: str) -> str:
    """Return the contradiction of a message's axes to ``imu.convention``; empty if none."""
    if convention == "frd":
        return ""
    if frame_id.endswith(("_frd", "_ned")):
        return (
            f"the Imu's frame_id '{frame_id}' contradicts imu.convention 'flu': set it to 'frd', "
            "or correct the frame_id"
        )
    if RATE_ADAPTERS[msgtype].frd:
        return f"{msgtype} is in forward-right-down axes: set imu.convention to 'frd'"
    return ""


# --- message classes -------------------------------------------------------------------------


def import_type(name: str) -> Any:
    """Import a message class by its name, ``package/msg/Type``.

    Raises
    ------
    MessageTypeError
        If the name has another form, or the package is not installed or has no such type.
    """
    try:
        package, kind, type_name = name.split("/")
        return getattr(importlib.import_module(f"{package}.{kind}"), type_name)
    except ValueError:
        raise MessageTypeError(f"'{name}' is no message type: write package/msg/Type") from None
    except ImportError:
        raise MessageTypeError(
            f"message type '{name}' is not installed: install the ROS package '{package}' and "
            "source it"
        ) from None
    except AttributeError:
        raise MessageTypeError(f"the ROS package '{package}' has no type '{name}'") from None
