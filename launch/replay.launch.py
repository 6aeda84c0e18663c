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
from launch.substitutions import FindExecutable, LaunchConfiguration, NotEqualsSubstitution

from uav_ident_ros.launching import (
    LaunchError,
    argument,
    common_arguments,
    fails_with,
    files_exist,
    in_config,
    node,
    remappings,
    topic_arguments,
)

CLOCK_RATE = "200.0"
"""Rate of /clock, Hz: unstamped messages are stamped with it when they arrive, and the default of
`ros2 bag play`, 40 Hz, would put them up to 25 ms off. Raise it with the argument rate."""

START_DELAY = "3.0"
"""Time for the node and the recorder to find the player before it begins, s: a best-effort
subscription misses what was sent before."""

LAST_TICKS = 2.0
"""Time after the last message in which its ticks are computed and recorded, s."""

NODE = "identifier"
RECORDED = f"/{NODE}/|^/diagnostics$"
"""Regular expression of the topics that are recorded: the node's own, in any namespace."""


def check_recording(context: LaunchContext) -> None:
    """End the launch if it cannot play or record, before a process is started."""
    FindExecutable(name="ros2").perform(context)
    folder = LaunchConfiguration("record").perform(context)
    if folder and Path(folder).exists():
        raise LaunchError(f"record '{folder}': it exists already; name a new folder")


def generate_launch_description() -> LaunchDescription:
    """Return the description that `ros2 launch` executes."""
    # neither the clock nor what other flights have shown is the file's
    own = {"use_sim_time": True, "state_file": "none"}
    identifier = node(NODE, NODE, own, remappings=remappings())
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
            *common_arguments(in_config("identifier.yaml")),
            DeclareLaunchArgument("bag", description="Bag to play: a rosbag2 folder or MCAP file"),
            argument("rate", "Speed of the playback, 1.0 for real time", "1.0"),
            argument("clock_rate", "Rate of /clock, Hz of the computer's time", CLOCK_RATE),
            argument("start_delay", "Wait before the playback, s", START_DELAY),
            argument("record", "Folder of a new bag with the node's topics; empty: none"),
            *topic_arguments("/"),  # a bag's topics do not follow the node's namespace
            files_exist("params_file", "bag"),
            OpaqueFunction(function=check_recording),
            *fails_with(identifier, recorder, player),
            end,
            identifier,
            recorder,
            player,
        ]
    )
