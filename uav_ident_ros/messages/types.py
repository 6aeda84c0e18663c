# SPDX-License-Identifier: Apache-2.0
"""ROS messages to plain values and back, for every supported type: one table.

The adapters use attribute access only, so they serve rclpy messages, rosbags messages and
stand-ins alike. Nothing here imports ROS until `import_type` is called.
"""

from __future__ import annotations

import difflib
import importlib
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.settings import ActuatorSettings
from uav_ident_ros.identification.structure import ROWS, FloatArray, Structure

NS_PER_S = 1_000_000_000
NS_PER_US = 1_000

Vector = tuple[float, float, float]


MOST_LISTED = 20
"""Names of a message that a complaint about it lists: more is no help, and floods the log."""


class MessageTypeError(Exception):
    """A message type or field is unknown or not installed; the message names it."""


class ChannelError(ValueError):
    """A message does not hold the configured channels; the message says why.

    Parameters
    ----------
    message : str
        What is wrong and what would be right.
    not_finite : bool
        Whether the channels are there, but hold NaN or infinity.
    """

    def __init__(self, message: str, *, not_finite: bool = False) -> None:
        super().__init__(message)
        self.not_finite = not_finite


class RatesReading(NamedTuple):
    """One message of the rates topic.

    Parameters
    ----------
    stamp_ns : int
        Message time, ns.
    rates : (3,) tuple or None
        Angular velocity, rad/s, in the sensor's axes; None if the message declares none.
    specific_force : (3,) tuple or None
        Specific force, m/s^2, in the sensor's axes; None if the message declares none.
    frame_id : str
        Frame of the header; empty if the type has none.
    """

    stamp_ns: int
    rates: Vector | None
    specific_force: Vector | None
    frame_id: str


class ActuatorReading(NamedTuple):
    """One message of the actuator topic.

    Parameters
    ----------
    stamp_ns : int or None
        Message time, ns; None if the type has no stamp and counts from its arrival.
    values : sequence of float
        Every raw channel of the message.
    names : sequence of str or None
        Their names; None if the type does not name them.
    """

    stamp_ns: int | None
    values: Sequence[float]
    names: Sequence[str] | None


@dataclass(frozen=True)
class RatesAdapter:
    """How to read one type of rates message.

    Parameters
    ----------
    read : callable
        Message to `RatesReading`.
    convention : str
        The axes that the type itself prescribes; empty if a parameter says.
    """

    read: Callable[[Any], RatesReading]
    convention: str = ""


@dataclass(frozen=True)
class ActuatorAdapter:
    """How to read one type of actuator message.

    Parameters
    ----------
    read : callable
        Message and name of an array field to `ActuatorReading`.
    fields : tuple of str
        The array fields that can hold the channels; the first is the usual one.
    unit : str
        Unit of the values, in words.
    stamped : bool
        Whether messages carry their own time.
    named : bool
        Whether messages name their channels.
    """

    read: Callable[[Any, str], ActuatorReading]
    fields: tuple[str, ...]
    unit: str
    stamped: bool = True
    named: bool = False


# --- reading ---------------------------------------------------------------------------------


def header_ns(message: Any) -> int:
    """Stamp of the message's std_msgs/Header, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def px4_ns(message: Any) -> int:
    """Time of the sample of a PX4 message, or of the message where it has no such field, ns."""
    return int(getattr(message, "timestamp_sample", 0) or message.timestamp) * NS_PER_US


def _read_imu(message: Any) -> RatesReading:
    # sensor_msgs/Imu: a covariance that starts with -1 means that there is no such measurement.
    rates = force = None
    if message.angular_velocity_covariance[0] != -1.0:
        rates = _xyz(message.angular_velocity)
    if message.linear_acceleration_covariance[0] != -1.0:
        force = _xyz(message.linear_acceleration)
    return RatesReading(header_ns(message), rates, force, message.header.frame_id)


def _xyz(vector: Any) -> Vector:
    return float(vector.x), float(vector.y), float(vector.z)


def _three(values: Any) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


def _read_px4_angular_velocity(message: Any) -> RatesReading:
    return RatesReading(px4_ns(message), _three(message.xyz), None, "")


PX4_RELATIVE_TIMESTAMP_INVALID = 0x7FFFFFFF
"""SensorCombined: there is no accelerometer sample."""


def _read_px4_sensor_combined(message: Any) -> RatesReading:
    force = None
    if message.accelerometer_timestamp_relative != PX4_RELATIVE_TIMESTAMP_INVALID:
        force = _three(message.accelerometer_m_s2)
    return RatesReading(px4_ns(message), _three(message.gyro_rad), force, "")


def _read_unstamped(message: Any, field: str) -> ActuatorReading:
    return ActuatorReading(None, getattr(message, field), None)


def _read_with_header(message: Any, field: str) -> ActuatorReading:
    return ActuatorReading(header_ns(message), getattr(message, field), None)


def _read_joint_state(message: Any, field: str) -> ActuatorReading:
    return ActuatorReading(header_ns(message), getattr(message, field), message.name)


def _read_px4(message: Any, field: str) -> ActuatorReading:
    return ActuatorReading(px4_ns(message), getattr(message, field), None)


def _read_px4_outputs(message: Any, field: str) -> ActuatorReading:
    values = getattr(message, field)[: int(message.noutputs)]
    return ActuatorReading(px4_ns(message), values, None)


_NORMALISED = "normalised, -1 to 1"
_PULSE_WIDTH = "pulse width, microseconds"
_AS_SENT = "as its publisher defines"

RATES: dict[str, RatesAdapter] = {
    "sensor_msgs/msg/Imu": RatesAdapter(_read_imu),
    "px4_msgs/msg/VehicleAngularVelocity": RatesAdapter(_read_px4_angular_velocity, "frd"),
    "px4_msgs/msg/SensorCombined": RatesAdapter(_read_px4_sensor_combined, "frd"),
}
"""The supported types of the rates topic."""

ACTUATORS: dict[str, ActuatorAdapter] = {
    "std_msgs/msg/Float64MultiArray": ActuatorAdapter(
        _read_unstamped, ("data",), _AS_SENT, stamped=False
    ),
    "std_msgs/msg/Float32MultiArray": ActuatorAdapter(
        _read_unstamped, ("data",), _AS_SENT, stamped=False
    ),
    "sensor_msgs/msg/JointState": ActuatorAdapter(
        _read_joint_state, ("position", "velocity", "effort"), "rad, rad/s or Nm", named=True
    ),
    "actuator_msgs/msg/Actuators": ActuatorAdapter(
        _read_with_header, ("position", "velocity", "normalized"), "rad, rad/s or -1 to 1"
    ),
    "mavros_msgs/msg/RCOut": ActuatorAdapter(_read_with_header, ("channels",), _PULSE_WIDTH),
    "mavros_msgs/msg/ActuatorControl": ActuatorAdapter(
        _read_with_header, ("controls",), _NORMALISED
    ),
    "px4_msgs/msg/ActuatorMotors": ActuatorAdapter(_read_px4, ("control",), _NORMALISED),
    "px4_msgs/msg/ActuatorServos": ActuatorAdapter(_read_px4, ("control",), _NORMALISED),
    "px4_msgs/msg/ActuatorOutputs": ActuatorAdapter(
        _read_px4_outputs, ("output",), "the output's own, mostly microseconds"
    ),
}
"""The supported types of the actuator topic."""


class ActuatorReader:
    """Reads the configured channels from actuator messages.

    Parameters
    ----------
    settings : ActuatorSettings
        Type, field and channels.

    Attributes
    ----------
    field : str
        The array field that is read.

    Raises
    ------
    MessageTypeError
        If the type has no such array field, or channels are named and the type names none.
    """

    def __init__(self, settings: ActuatorSettings) -> None:
        adapter = ACTUATORS[settings.type]
        self._read = adapter.read
        self.field = settings.field or adapter.fields[0]
        if self.field not in adapter.fields:
            raise MessageTypeError(
                f"'actuators.field' is '{settings.field}': {settings.type} has "
                f"{', '.join(adapter.fields)}"
            )
        self._channels = settings.channels
        self._indices: list[int] = []
        self._names: list[str] | None = None  # of the newest message
        if not isinstance(settings.channels[0], str):
            self._indices = [int(channel) for channel in settings.channels]
        elif not adapter.named:
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
        return self.select(self._read(message, self.field))

    def select(self, reading: ActuatorReading) -> tuple[int | None, tuple[float, ...]]:
        """Return the same from what was read already."""
        if reading.names is not None and reading.names != self._names:
            self._find(list(reading.names))
        values = reading.values
        try:
            selected = tuple([float(values[i]) for i in self._indices])
        except IndexError:
            raise ChannelError(
                f"'{self.field}' has {len(values)} values, too few for channels "
                f"{_listed(self._channels)}"
            ) from None
        if not math.isfinite(sum(selected)):  # a sum of finite channels does not overflow
            raise ChannelError(
                f"channels {_listed(self._channels)} are {_listed(selected)}: not all finite",
                not_finite=True,
            )
        return reading.stamp_ns, selected

    def _find(self, names: list[str]) -> None:
        """Look the configured channels up among the `names` of a message."""
        if isinstance(self._channels[0], str):
            indices = []
            for channel in self._channels:
                if channel not in names:
                    near = difflib.get_close_matches(str(channel), names, n=1)
                    hint = f"; did you mean '{near[0]}'?" if near else ""
                    found = f" among {_listed(names)}" if names else ": the message names none"
                    raise ChannelError(f"there is no channel '{channel}'{found}{hint}")
                indices.append(names.index(str(channel)))
            self._indices = indices
        self._names = names


def _listed(items: Sequence[object]) -> str:
    shown = ", ".join(f"{item}" for item in items[:MOST_LISTED]) or "none"
    return f"{shown} and {len(items) - MOST_LISTED} more" if len(items) > MOST_LISTED else shown


def frame_fault(convention: str, frame_id: str, msgtype: str) -> str:
    """Say how a message's axes contradict the configured convention; empty if they do not.

    Parameters
    ----------
    convention : str
        Setting ``imu.convention``: ``flu`` or ``frd``.
    frame_id : str
        Frame of the message's header.
    msgtype : str
        Type of the rates topic.
    """
    if convention == "frd":
        return ""
    if frame_id.endswith(("_frd", "_ned")):
        return (
            f"the Imu's frame_id '{frame_id}' contradicts imu.convention 'flu': set it to 'frd', "
            "or correct the frame_id"
        )
    if RATES[msgtype].convention == "frd":
        return f"{msgtype} is in forward-right-down axes: set imu.convention to 'frd'"
    return ""


# --- Imu from bytes --------------------------------------------------------------------------

_CDR_HEADER = 4
"""Encapsulation header before the CDR body, bytes."""

_IMU_BODY_DOUBLES = 37
"""Doubles of an Imu after its header: 4 + 9, 3 + 9, 3 + 9."""

# Stamp and length of the frame_id; then, from the first double on: orientation with its
# covariance, rates, first entry of their covariance, the rest of it, and the force likewise.
_IMU_FORMATS = {
    b"\x00\x01": (struct.Struct("<iII"), struct.Struct("<104x4d64x4d")),
    b"\x00\x00": (struct.Struct(">iII"), struct.Struct(">104x4d64x4d")),
}
_IMU_PREFIX_SIZE = 12
_CDR_ALIGNMENT = 8


def decode_imu_cdr(data: bytes) -> RatesReading | None:
    """Read an Imu message from its CDR bytes, several times faster than a decoder in Python.

    Parameters
    ----------
    data : bytes
        Serialized sensor_msgs/msg/Imu with its encapsulation header (XCDR1, either byte order).

    Returns
    -------
    RatesReading or None
        None if the bytes are not of that form: leave them to a full decoder.
    """
    formats = _IMU_FORMATS.get(bytes(data[:2]))
    if formats is None or len(data) < _CDR_HEADER + _IMU_PREFIX_SIZE:
        return None
    prefix, vectors = formats
    seconds, nanoseconds, length = prefix.unpack_from(data, _CDR_HEADER)
    start = _CDR_HEADER + _IMU_PREFIX_SIZE
    body = ((_IMU_PREFIX_SIZE + length + _CDR_ALIGNMENT - 1) & -_CDR_ALIGNMENT) + _CDR_HEADER
    if length < 1 or len(data) < body + 8 * _IMU_BODY_DOUBLES:
        return None
    p, q, r, rate_covariance, ax, ay, az, force_covariance = vectors.unpack_from(data, body)
    try:
        frame_id = str(data[start : start + length - 1], "utf-8")
    except UnicodeDecodeError:
        return None
    return RatesReading(
        seconds * NS_PER_S + nanoseconds,
        None if rate_covariance == -1.0 else (p, q, r),
        None if force_covariance == -1.0 else (ax, ay, az),
        frame_id,
    )


# --- message classes -------------------------------------------------------------------------


def import_type(name: str) -> Any:
    """Import a message class by its name.

    Parameters
    ----------
    name : str
        ``package/msg/Type``.

    Raises
    ------
    MessageTypeError
        If the package is not installed or has no such type.
    """
    try:
        package, kind, type_name = name.split("/")
    except ValueError:
        raise MessageTypeError(f"'{name}' is not of the form package/msg/Type") from None
    try:
        module = importlib.import_module(f"{package}.{kind}")
    except ImportError:
        raise MessageTypeError(
            f"message type '{name}' is not installed: install the ROS package '{package}' and "
            "source it"
        ) from None
    try:
        return getattr(module, type_name)
    except AttributeError:
        raise MessageTypeError(f"the ROS package '{package}' has no type '{name}'") from None


# --- building --------------------------------------------------------------------------------


class Dimension(NamedTuple):
    """One std_msgs/msg/MultiArrayDimension."""

    label: str
    size: int
    stride: int


def coefficients_layout(structure: Structure) -> tuple[Dimension, Dimension]:
    """Layout of ~/coefficients: the dense matrix of moment and force rows, row-major."""
    rows, n = len(structure.dense_rows), structure.size
    return (
        Dimension(",".join(structure.dense_rows), rows, rows * n),
        Dimension(",".join(structure.regressors), n, n),
    )


STATE_FIELDS = ("alpha", "beta", "roll", "pitch", "airspeed")
STATE_NAMES = tuple(f"state/{field}" for field in STATE_FIELDS)
"""States of a structure with flow angles beside the rates: rad, rad, rad, rad, m/s."""

FIT_NAMES = ("fit/p", "fit/q", "fit/r")
USABLE_NAME = "verdict/usable"
ROW_USABLE_NAMES = tuple(f"{USABLE_NAME}/{row}" for row in ROWS)


def entry_names(structure: Structure) -> tuple[str, ...]:
    """Names in ~/coefficients_named: coefficients, states, the fit of each axis, verdicts."""
    states = STATE_NAMES if structure.has_flow else ()
    return (*structure.names, *states, *FIT_NAMES, USABLE_NAME, *ROW_USABLE_NAMES)


def dense_coefficients(estimate: Estimate, structure: Structure) -> FloatArray:
    """Matrix of ~/coefficients of an estimate."""
    return estimate.coefficients[: len(structure.dense_rows)]


class NamedEntries(NamedTuple):
    """Content of ~/coefficients_named.

    Parameters
    ----------
    names : tuple of str
        See `entry_names`.
    positions : (k,) array
        Values, SI; the fits in percent; 1 or 0 for usable.
    efforts : (k,) array
        One standard deviation of each coefficient and flow angle, 0 for the others.
    """

    names: tuple[str, ...]
    positions: FloatArray
    efforts: FloatArray


def named_entries(estimate: Estimate, structure: Structure) -> NamedEntries:
    """Entries of ~/coefficients_named of an estimate."""
    verdict = (float(estimate.usable), *map(float, estimate.usable_rows))
    mask, flow = structure.mask, estimate.flow
    states: tuple[float, ...] = ()
    spreads: tuple[float, ...] = ()
    if flow is not None:
        states = tuple(getattr(flow, field) for field in STATE_FIELDS)
        spreads = (flow.alpha_sigma, flow.beta_sigma, 0.0, 0.0, 0.0)
    positions = np.concatenate([estimate.coefficients[mask], states, estimate.fit, verdict])
    rest = np.zeros(len(FIT_NAMES) + len(verdict))
    efforts = np.concatenate([estimate.sigma[mask], spreads, rest])
    return NamedEntries(entry_names(structure), positions, efforts)
