# SPDX-License-Identifier: Apache-2.0
"""Common parts of the launch files: arguments, nodes, and an end with status 1 on a failure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from launch import LaunchContext
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.some_entities_type import SomeEntitiesType
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

from uav_ident_ros.commandline import USAGE_ERROR
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.share import PACKAGE


class LaunchError(Exception):
    """Failure of a launch: launch prints it, ends all processes and exits with status 1."""


def in_config(*parts: str) -> PathJoinSubstitution:
    """Return the path of an installed configuration."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), "config", *parts])


def argument(
    name: str, description: str, default: Any = "", choices: list[str] | None = None
) -> DeclareLaunchArgument:
    """Return an argument that `ros2 launch --show-args` lists."""
    return DeclareLaunchArgument(
        name, default_value=default, description=description, choices=choices
    )


def flag(name: str, description: str, default: str = "false") -> DeclareLaunchArgument:
    """Return an argument that is true or false."""
    return argument(name, description, default, ["true", "false"])


def value(name: str, kind: type) -> ParameterValue:
    """Return the value of an argument, of this type, for a parameter of a node."""
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def common_arguments(params_file: PathJoinSubstitution) -> list[DeclareLaunchArgument]:
    """Return the arguments of every `node`: parameter file, namespace, log level."""
    levels = ["debug", "info", "warn", "error", "fatal"]
    return [
        argument(
            "params_file",
            "ROS 2 parameter file; its sections are the full names of nodes, or /**",
            params_file,
        ),
        argument("namespace", "Namespace of the nodes, one for each vehicle"),
        argument("log_level", "Least severe message that is logged", "info", levels),
    ]


def topic_arguments(prefix: str = "") -> list[DeclareLaunchArgument]:
    """Return a topic argument for each input, by default the input's name."""
    arguments = []
    for stream in STREAMS:
        text = f"Topic of the input {stream.topic}"
        if stream.optional and stream.setting:
            text += f"; it is read if the parameter {stream.setting} names its type"
        arguments.append(argument(_topic_argument(stream.topic), text, prefix + stream.topic))
    return arguments


def remappings() -> list[tuple[str, LaunchConfiguration]]:
    """Return each input's name with its topic argument."""
    return [(s.topic, LaunchConfiguration(_topic_argument(s.topic))) for s in STREAMS]


def _topic_argument(topic: str) -> str:
    return f"{topic.split('/')[0]}_topic"


def node(executable: str, name: str, parameters: dict[str, Any], **options: Any) -> Node:
    """Return a node of this package; its parameters override those of the parameter file."""
    return Node(
        package=PACKAGE,
        executable=executable,
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=[ParameterFile(LaunchConfiguration("params_file")), parameters],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        output="screen",
        emulate_tty=True,
        **options,
    )


def files_exist(*arguments: str) -> OpaqueFunction:
    """Return an action that ends the launch if the path in an argument does not exist.

    The action must precede the processes: launch does not end those started before an error in the
    same description. launch_ros itself ignores a missing parameter file.
    """

    def check(context: LaunchContext) -> None:
        for name in arguments:
            path = LaunchConfiguration(name).perform(context)
            if not Path(path).exists():
                expanded = Path(path).expanduser()
                hint = f"; write {name}:={expanded}" if expanded.exists() else ""
                raise LaunchError(f"{name} '{path}': there is no such file{hint}")

    return OpaqueFunction(function=check)


def fails_with(
    *processes: Action,  # The processes to watch
    # Launch argument that restarts them instead, except after a usage error
    respawn: str | None = None,
) -> list[RegisterEventHandler]:
    """Return the handlers that end the launch, with status 1, if one of its processes fails."""

    def judge(event: ProcessExited, context: LaunchContext) -> SomeEntitiesType | None:
        status = event.returncode
        again = respawn is not None and LaunchConfiguration(respawn).perform(context) == "true"
        if status == 0 or context.is_shutdown or (again and status != USAGE_ERROR):
            return None
        raise LaunchError(f"'{event.process_name}' ended with status {status}")

    return [
        RegisterEventHandler(OnProcessExit(target_action=process, on_exit=judge))
        for process in processes
    ]
