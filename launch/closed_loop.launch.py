# SPDX-License-Identifier: Apache-2.0
"""Fly a JSBSim aircraft with the example controller on identified coefficients.

ros2 launch uav_ident_ros closed_loop.launch.py fault:="60: aileron effect 0.5"
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

from uav_ident_ros.launching import fails_with, files_exist

PACKAGE = "uav_ident_ros"
PARAMS = "c172p.yaml"
COEFFICIENTS = "c172p_coefficients.yaml"


def in_share(name: str) -> PathJoinSubstitution:
    """Return the path of an installed configuration of the closed loop."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "closed_loop", name])


def declare_arguments() -> list[DeclareLaunchArgument]:
    """Return the arguments that `ros2 launch --show-args` lists."""
    return [
        DeclareLaunchArgument(
            "params_file",
            default_value=in_share(PARAMS),
            description="Parameters of all four nodes; its sections name them",
        ),
        DeclareLaunchArgument(
            "coefficients_file",
            default_value=in_share(COEFFICIENTS),
            description="Where the identifier starts, and the controller's nominal set",
        ),
        DeclareLaunchArgument(
            "mode",
            default_value="adaptive",
            choices=["adaptive", "fixed"],
            description="Controller on the identified or on the nominal coefficients",
        ),
        DeclareLaunchArgument(
            "heed_verdict",
            default_value="true",
            choices=["true", "false"],
            description="Whether the controller heeds verdict/usable, or each sigma alone",
        ),
        DeclareLaunchArgument(
            "fault",
            default_value="",
            description="What goes wrong and when: '60: aileron effect 0.5'. Empty: nothing",
        ),
        DeclareLaunchArgument("duration", default_value="120.0", description="Of the flight, s"),
        DeclareLaunchArgument(
            "seed", default_value="0", description="Of noise, gusts and manoeuvres"
        ),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of all nodes"),
        DeclareLaunchArgument(
            "log_level",
            default_value="info",
            choices=["debug", "info", "warn", "error", "fatal"],
            description="Least severe message that is logged",
        ),
    ]


def node(executable: str, name: str, parameters: dict) -> Node:
    """Return a node of this package, with the common parameter file."""
    return Node(
        package=PACKAGE,
        executable=executable,
        name=name,
        namespace=LaunchConfiguration("namespace"),
        # the later entry wins
        parameters=[ParameterFile(LaunchConfiguration("params_file")), parameters],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        output="screen",
        emulate_tty=True,
    )


def generate_launch_description() -> LaunchDescription:
    """Return the description that `ros2 launch` executes; it ends when the plant has landed."""
    coefficients = LaunchConfiguration("coefficients_file")
    plant = node(
        "simulated_plant",
        "simulated_plant",
        {
            "duration": ParameterValue(LaunchConfiguration("duration"), value_type=float),
            "seed": ParameterValue(LaunchConfiguration("seed"), value_type=int),
            # a list: launch_ros would take a fault, with its colon, for a YAML mapping
            "faults": ParameterValue(
                ["['", LaunchConfiguration("fault"), "']"], value_type=list[str]
            ),
        },
    )
    others = [
        node("identifier", "identifier", {"initial_coefficients_file": coefficients}),
        node(
            "controller_example",
            "controller",
            {
                "nominal_file": coefficients,
                "mode": LaunchConfiguration("mode"),
                "heed_verdict": ParameterValue(
                    LaunchConfiguration("heed_verdict"), value_type=bool
                ),
            },
        ),
        node(
            "rate_reference",
            "rate_reference",
            {"seed": ParameterValue(LaunchConfiguration("seed"), value_type=int)},
        ),
    ]
    landed = OnProcessExit(target_action=plant, on_exit=Shutdown(reason="the flight is over"))
    return LaunchDescription(
        [
            *declare_arguments(),
            files_exist("params_file", "coefficients_file"),
            *fails_with(plant, *others),
            RegisterEventHandler(landed),
            plant,  # first: should an argument of it be wrong, nobody else has started
            *others,
        ]
    )
