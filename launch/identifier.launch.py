# SPDX-License-Identifier: Apache-2.0
"""Start the identifier beside an autopilot, a simulator or a bag.

ros2 launch uav_ident_ros identifier.launch.py params_file:=/path/to/vehicle.yaml \
    imu_topic:=/mavros/imu/data_raw actuators_topic:=/mavros/rc/out
"""

from launch import LaunchDescription
from launch.substitutions import LaunchConfiguration

from uav_ident_ros.launching import (
    common_arguments,
    fails_with,
    files_exist,
    flag,
    in_config,
    node,
    remappings,
    topic_arguments,
    value,
)

RESPAWN_DELAY = 1.0
"""Delay of a restart, s: a node that crashes immediately does not occupy the processor."""


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    identifier = node(
        "identifier",
        "identifier",
        {"use_sim_time": value("use_sim_time", bool)},
        remappings=remappings(),
        respawn=LaunchConfiguration("respawn"),
        respawn_delay=RESPAWN_DELAY,
    )
    return LaunchDescription(
        [
            *common_arguments(in_config("identifier.yaml")),
            flag("use_sim_time", "Take the time from /clock, of a simulator or of a played bag"),
            flag("respawn", "Start the node again if it ends; it goes on from its state file"),
            *topic_arguments(),
            files_exist("params_file"),
            *fails_with(identifier, respawn="respawn"),
            identifier,
        ]
    )
