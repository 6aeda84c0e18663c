# SPDX-License-Identifier: Apache-2.0
"""Armed messages to plain values, for every supported type.

The readers use attribute access only, so they serve rclpy messages, rosbags messages and
stand-ins alike.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from uav_ident_ros.messages.types import NS_PER_US, header_ns

PX4_ARMING_STATE_ARMED = 2
"""VehicleStatus: the value of `arming_state` while armed."""


class ArmedReading(NamedTuple):
    """One message of the armed topic.

    Parameters
    ----------
    stamp_ns : int or None
        Message time, ns; None if the type has no stamp and counts from its arrival.
    armed : bool
        Whether the motors are armed.
    """

    stamp_ns: int | None
    armed: bool


def _read_bool(message: Any) -> ArmedReading:
    return ArmedReading(None, bool(message.data))


def _read_mavros(message: Any) -> ArmedReading:
    return ArmedReading(header_ns(message), bool(message.armed))


def _read_px4_status(message: Any) -> ArmedReading:
    armed = int(message.arming_state) == PX4_ARMING_STATE_ARMED
    return ArmedReading(int(message.timestamp) * NS_PER_US, armed)


def _read_px4_armed(message: Any) -> ArmedReading:
    return ArmedReading(int(message.timestamp) * NS_PER_US, bool(message.armed))


ARMED: dict[str, Callable[[Any], ArmedReading]] = {
    "std_msgs/msg/Bool": _read_bool,
    "mavros_msgs/msg/State": _read_mavros,
    "px4_msgs/msg/VehicleStatus": _read_px4_status,
    "px4_msgs/msg/ActuatorArmed": _read_px4_armed,
}
"""The supported types of the armed topic."""
