# SPDX-License-Identifier: Apache-2.0
"""Play a bag to the identifier, on the bag's own clock; stops when the bag ends.

ros2 launch uav_ident_ros replay.launch.py bag:=/path/to/bag params_file:=/path/to/vehicle.yaml \
    record:=/path/to/new/bag

Needs ros2bag. The same without the middleware, and faster: `ros2 run uav_ident_ros replay BAG`.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.substitutions import (
    FindExecutable,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile
from launch_ros.substitutions import FindPackageShare

from uav_ident_ros.launching import LaunchError, fails_with, files_exist

PACKAGE = "uav_ident_ros"
DEFAULT_PARAMS = "identifier.yaml"

CLOCK_RATE = "200.0"
"""Rate of /clock, Hz: unstamped messages are stamped with it when they arrive, and the default of
`ros2 bag play`, 40 Hz, would put them up to 25 ms off."""

START_DELAY = "3.0"
"""Time for the node and the recorder to find the player before it begins, s: a best-effort
subscription misses what was sent before."""

LAST_TICKS = 2.0
"""Time after the last message in which its ticks are computed and recorded, s."""

NODE = "identifier"
RECORDED = f"/{NODE}/|^/diagnostics$"
"""Regular expression of the topics that are recorded: the node's own, in any namespace."""


def declare_arguments() -> list[DeclareLaunchArgument]:
    """Return the arguments that `ros2 launch --show-args` lists."""
    return [
        DeclareLaunchArgument("bag", description="The bag to play: a rosbag2 folder or MCAP file"),
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution(
                [FindPackageShare(PACKAGE), "config", DEFAULT_PARAMS]
            ),
            description="ROS 2 parameter file of the vehicle. Default: every parameter at its"
            " default",
        ),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
        DeclareLaunchArgument(
            "imu_topic", default_value="/imu/data", description="Topic of the Imu in the bag"
        ),
        DeclareLaunchArgument(
            "actuators_topic",
            default_value="/actuators",
            description="Topic of the actuator array in the bag",
        ),
        DeclareLaunchArgument(
            "airspeed_topic",
            default_value="/airspeed",
            description="Topic of the airspeed in the bag, if airspeed.type is set",
        ),
        DeclareLaunchArgument(
            "armed_topic",
            default_value="/armed",
            description="Topic of whether it is armed in the bag, if armed.type is set",
        ),
        DeclareLaunchArgument(
            "excitation_topic",
            default_value="/excitation",
            description="Topic of what was injected into the inputs, if the bag has one",
        ),
        DeclareLaunchArgument(
            "rate", default_value="1.0", description="Speed of the playback, 1.0 for real time"
        ),
        DeclareLaunchArgument(
            "clock_rate",
            default_value=CLOCK_RATE,
            description="Rate of /clock, Hz of the computer's time: raise it with rate",
        ),
        DeclareLaunchArgument(
            "start_delay", default_value=START_DELAY, description="Wait before the playback, s"
        ),
        DeclareLaunchArgument(
            "record",
            default_value="",
            description="Folder of a new bag with the node's topics; empty: record nothing",
        ),
        DeclareLaunchArgument(
            "log_level",
            default_value="info",
            choices=["debug", "info", "warn", "error", "fatal"],
            description="Least severe message that is logged",
        ),
    ]


def check_recording(context: LaunchContext) -> None:
    """End the launch if it cannot play or record, before a process is started."""
    FindExecutable(name="ros2").perform(context)
    folder = LaunchConfiguration("record").perform(context)
    if folder and Path(folder).exists():
        raise LaunchError(f"record '{folder}': it exists already; name a new folder")


def generate_launch_description() -> LaunchDescription:
    """Return the description that `ros2 launch` executes."""
    identifier = Node(
        package=PACKAGE,
        executable=NODE,
        name=NODE,
        namespace=LaunchConfiguration("namespace"),
        # the later entry wins: neither the clock nor what other flights have shown is the file's
        parameters=[
            ParameterFile(LaunchConfiguration("params_file")),
            {"use_sim_time": True, "state_file": "none"},
        ],
        remappings=[
            ("imu/data", LaunchConfiguration("imu_topic")),
            ("actuators", LaunchConfiguration("actuators_topic")),
            ("airspeed", LaunchConfiguration("airspeed_topic")),
            ("armed", LaunchConfiguration("armed_topic")),
            ("excitation", LaunchConfiguration("excitation_topic")),
        ],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        output="screen",
        emulate_tty=True,
    )
    recorder = ExecuteProcess(
        cmd=[
            *(FindExecutable(name="ros2"), "bag", "record"),
            *("--output", LaunchConfiguration("record"), "--storage", "mcap"),
            *("--use-sim-time", "--regex", RECORDED),
        ],
        condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration("record"), "")),
        output="screen",
    )
    player = ExecuteProcess(
        cmd=[
            *(FindExecutable(name="ros2"), "bag", "play", LaunchConfiguration("bag")),
            *("--clock", LaunchConfiguration("clock_rate"), "--rate", LaunchConfiguration("rate")),
            *("--delay", LaunchConfiguration("start_delay"), "--disable-keyboard-controls"),
        ],
        output="screen",
    )
    end = RegisterEventHandler(
        OnProcessExit(
            target_action=player,
            on_exit=[
                TimerAction(period=LAST_TICKS, actions=[Shutdown(reason="the bag has ended")])
            ],
        )
    )
    return LaunchDescription(
        [
            *declare_arguments(),
            files_exist("params_file", "bag"),
            OpaqueFunction(function=check_recording),
            *fails_with(identifier, recorder, player),
            end,
            identifier,
            recorder,
            player,
        ]
    )
