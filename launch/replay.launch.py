# SPDX-License-Identifier: Apache-2.0
"""Play a bag to the identifier, on the bag's own clock; end with the bag.

ros2 launch uav_ident_ros replay.launch.py bag:=/path/to/bag params_file:=/path/to/vehicle.yaml \
    record:=/path/to/new/bag

It needs ros2bag. `ros2 run uav_ident_ros replay BAG` is faster and needs no middleware.
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
"""Rate of /clock, Hz. Unstamped messages are stamped with it on arrival: the default of
`ros2 bag play`, 40 Hz, gives errors up to 25 ms. It must grow with the argument rate."""

START_DELAY = "3.0"
"""Time for discovery before the player starts, s: a best-effort subscription misses earlier
messages."""

LAST_TICKS = 2.0
"""Time after the last message for its ticks to be computed and recorded, s."""

NODE = "identifier"
RECORDED = f"/{NODE}/|^/diagnostics$"
"""Regular expression of the recorded topics: the node's own, in any namespace."""


def check_recording(context: LaunchContext) -> None:
    """End the launch before any process if it cannot play or record."""
    FindExecutable(name="ros2").perform(context)
    folder = LaunchConfiguration("record").perform(context)
    if folder and Path(folder).exists():
        raise LaunchError(f"record '{folder}': it exists already; name a new folder")


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    # override the file: simulated time, and no coefficients of other flights
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
            *topic_arguments("/"),  # a bag's topics are outside of the node's namespace
            files_exist("params_file", "bag"),
            OpaqueFunction(function=check_recording),
            *fails_with(identifier, recorder, player),
            end,
            identifier,
            recorder,
            player,
        ]
    )
