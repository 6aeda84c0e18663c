# SPDX-License-Identifier: Apache-2.0
"""Airspeed messages to plain values, for every supported type.

The readers use attribute access only, so they serve rclpy messages, rosbags messages and
stand-ins alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from uav_ident_ros.messages.types import NS_PER_US, header_ns


class AirspeedReading(NamedTuple):
    """One message of the airspeed topic.

    Parameters
    ----------
    stamp_ns : int or None
        Message time, ns; None if the type has no stamp and counts from its arrival.
    airspeed : float
        True airspeed, m/s; NaN if the message declares none.
    """

    stamp_ns: int | None
    airspeed: float


def _read_number(message: Any) -> AirspeedReading:
    return AirspeedReading(None, float(message.data))


def _read_twist(message: Any) -> AirspeedReading:
    v = message.twist.linear
    return AirspeedReading(header_ns(message), math.hypot(v.x, v.y, v.z))


def _read_vfr_hud(message: Any) -> AirspeedReading:
    return AirspeedReading(header_ns(message), float(message.airspeed))


def _read_px4(message: Any) -> AirspeedReading:
    # PX4 publishes NaN while no airspeed is valid.
    return AirspeedReading(int(message.timestamp) * NS_PER_US, float(message.true_airspeed_m_s))


AIRSPEED: dict[str, Callable[[Any], AirspeedReading]] = {
    "std_msgs/msg/Float64": _read_number,
    "std_msgs/msg/Float32": _read_number,
    "geometry_msgs/msg/TwistStamped": _read_twist,
    "mavros_msgs/msg/VfrHud": _read_vfr_hud,
    "px4_msgs/msg/AirspeedValidated": _read_px4,
}
"""The supported types of the airspeed topic."""
