# SPDX-License-Identifier: Apache-2.0
"""Fly a JSBSim aircraft with the example controller on identified coefficients.

ros2 launch uav_ident_ros closed_loop.launch.py fault:="60: aileron effect 0.5"
"""

from launch import LaunchDescription
from launch.actions import RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from uav_ident_ros.launching import (
    argument,
    common_arguments,
    fails_with,
    files_exist,
    flag,
    in_config,
    node,
    value,
)


def generate_launch_description() -> LaunchDescription:
    """Return the launch description; the launch ends with the plant's flight."""
    coefficients = LaunchConfiguration("coefficients_file")
    plant = node(
        "simulated_plant",
        "simulated_plant",
        {
            "duration": value("duration", float),
            "seed": value("seed", int),
            # a list: launch_ros would parse a fault, with its colon, as a YAML mapping
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
                "use_verdict": value("use_verdict", bool),
            },
        ),
        node("rate_reference", "rate_reference", {"seed": value("seed", int)}),
    ]
    landed = OnProcessExit(target_action=plant, on_exit=Shutdown(reason="the flight is over"))
    return LaunchDescription(
        [
            *common_arguments(in_config("closed_loop", "c172p.yaml")),
            argument(
                "coefficients_file",
                "Where the identifier starts, and the controller's nominal set",
                in_config("closed_loop", "c172p_coefficients.yaml"),
            ),
            argument(
                "mode",
                "Controller on the identified or on the nominal coefficients",
                "adaptive",
                ["adaptive", "fixed"],
            ),
            flag(
                "use_verdict",
                "Whether the controller follows verdict/usable, or each sigma alone",
                "true",
            ),
            argument("fault", "What goes wrong and when: '60: aileron effect 0.5'; empty: nothing"),
            argument("duration", "Of the flight, s", "120.0"),
            argument("seed", "Of noise, gusts and manoeuvres", "0"),
            files_exist("params_file", "coefficients_file"),
            *fails_with(plant, *others),
            RegisterEventHandler(landed),
            plant,  # first: a wrong argument ends the launch before the other processes
            *others,
        ]
    )
