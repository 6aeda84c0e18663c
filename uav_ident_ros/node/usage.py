# SPDX-License-Identifier: Apache-2.0
"""What ``--help`` prints."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from uav_ident_ros.files.parameter_template import written
from uav_ident_ros.identification.settings import Setting, declarations

ROS_ARGUMENTS = "[--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r FROM:=TO] ...]"

HEAD = f"""\
usage: identifier {ROS_ARGUMENTS}

Identify the attitude dynamics of an unmanned aircraft while it flies.

topics in:   imu/data, actuators, excitation; airspeed and armed if their type is set
topics out:  ~/coefficients_named, ~/coefficients, ~/predicted_rates, ~/prediction_error,
             ~/excitation, /diagnostics
services:    ~/reset, ~/save, ~/adapt, ~/excite
exit status: 0, it was asked to end; 2, it was started wrongly, and one line says how

parameters, with their defaults:"""


def identifier_usage() -> str:
    """Return the text of the identifier: how it is started, what it speaks, every parameter."""
    return "\n".join((HEAD, *map(_entry, declarations())))


def node_usage(
    name: str,  # Of the program
    text: str,  # What it does; the docstring of its module
    parameters: Mapping[str, Any],  # Names and defaults
) -> str:
    """Return the text of another node of this package."""
    head = f"usage: {name} {ROS_ARGUMENTS}\n\n{text.strip()}\n\nparameters, with their defaults:"
    return "\n".join((head, *(f"  {key} = {written(value)}" for key, value in parameters.items())))


def _entry(setting: Setting) -> str:
    unit = f" {setting.unit}" if setting.unit else ""
    lines = textwrap.wrap(setting.description, 76)
    meaning = textwrap.indent("\n".join(lines), " " * 6)
    return f"  {setting.name} = {written(setting.default)}{unit}\n{meaning}"
