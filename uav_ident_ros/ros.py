# SPDX-License-Identifier: Apache-2.0
"""Common parts of the ROS nodes: stamps from nanoseconds, and latched topics."""

from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from uav_ident_ros.messages.types import NS_PER_S

RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def latched(depth: int) -> QoSProfile:
    """Return the QoS profile of latched topics: a late subscriber receives the last messages."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def to_stamp(t_ns: int) -> Time:
    """Return a time in ns as a stamp."""
    return Time(sec=t_ns // NS_PER_S, nanosec=t_ns % NS_PER_S)
