# SPDX-License-Identifier: Apache-2.0
"""Common parts of the ROS nodes: stamps from nanoseconds, latched topics, the domain."""

import os

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


def domain() -> str:
    """Return the words for the ROS domain of this process, in questions about a silent topic."""
    return f"with ROS_DOMAIN_ID {os.environ.get('ROS_DOMAIN_ID') or '0'}"


def to_stamp(t_ns: int) -> Time:
    """Return a time in ns as a stamp."""
    return Time(sec=t_ns // NS_PER_S, nanosec=t_ns % NS_PER_S)
