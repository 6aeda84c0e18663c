# SPDX-License-Identifier: Apache-2.0
"""Start the identifier beside an autopilot, a simulator or a bag.

ros2 launch uav_ident_ros identifier.launch.py params_file:=/path/to/vehicle.yaml \
    imu_topic:=/mavros/imu/data_raw actuators_topic:=/mavros/rc/out
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

from uav_ident_ros.launching import fails_with, files_exist

PACKAGE = "uav_ident_ros"
DEFAULT_PARAMS = "identifier.yaml"

RESPAWN_DELAY = 1.0
"""Time until a node that ended is started again, s: a crash at once does not take the processor."""


def declare_arguments() -> list[DeclareLaunchArgument]:
    """Return the arguments that `ros2 launch --show-args` lists."""
    return [
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution(
                [FindPackageShare(PACKAGE), "config", DEFAULT_PARAMS]
            ),
            description="ROS 2 parameter file of the vehicle; its sections must match the"
            " node's full name, or be /**. Default: every parameter at its default",
        ),
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="Namespace of the node, one for each vehicle",
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=["true", "false"],
            description="Take the time from /clock: true with a simulator or a played bag"
            " (ros2 bag play --clock 100)",
        ),
        DeclareLaunchArgument(
            "log_level",
            default_value="info",
            choices=["debug", "info", "warn", "error", "fatal"],
            description="Least severe message that is logged",
        ),
        DeclareLaunchArgument(
            "respawn",
            default_value="false",
            choices=["true", "false"],
            description="Start the node again if it ends; it goes on from its state file",
        ),
        DeclareLaunchArgument(
            "imu_topic",
            default_value="imu/data",
            description="Topic of the Imu, relative to the namespace unless it starts with /",
        ),
        DeclareLaunchArgument(
            "actuators_topic",
            default_value="actuators",
            description="Topic of the actuator array, relative to the namespace unless it"
            " starts with /",
        ),
        DeclareLaunchArgument(
            "airspeed_topic",
            default_value="airspeed",
            description="Topic of the true airspeed; read only if the parameter airspeed.type"
            " names its type",
        ),
        DeclareLaunchArgument(
            "armed_topic",
            default_value="armed",
            description="Topic that says whether the vehicle is armed; read only if the parameter"
            " armed.type names its type",
        ),
        DeclareLaunchArgument(
            "excitation_topic",
            default_value="excitation",
            description="Topic on which somebody else says what is injected into the inputs",
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the description that `ros2 launch` executes."""
    identifier = Node(
        package=PACKAGE,
        executable="identifier",
        name="identifier",
        namespace=LaunchConfiguration("namespace"),
        # the later entry wins: the argument decides about the clock, not the file
        parameters=[
            ParameterFile(LaunchConfiguration("params_file")),
            {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)},
        ],
        remappings=[
            ("imu/data", LaunchConfiguration("imu_topic")),
            ("actuators", LaunchConfiguration("actuators_topic")),
            ("airspeed", LaunchConfiguration("airspeed_topic")),
            ("armed", LaunchConfiguration("armed_topic")),
            ("excitation", LaunchConfiguration("excitation_topic")),
        ],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        respawn=LaunchConfiguration("respawn"),
        respawn_delay=RESPAWN_DELAY,
        output="screen",
        emulate_tty=True,
    )
    return LaunchDescription(
        [
            *declare_arguments(),
            files_exist("params_file"),
            *fails_with(identifier, respawn="respawn"),
            identifier,
        ]
    )
