# SPDX-License-Identifier: Apache-2.0
"""Starting ROS, and one line for whatever is wrong with the command line or the parameters."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence

import rclpy
import rclpy.logging
from rclpy.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NameValidationException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import LoggingSeverity
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from uav_ident_ros.files.coefficients_file import CoefficientsFileError
from uav_ident_ros.files.parameter_file import ParameterFile, ParameterFileError
from uav_ident_ros.identification.settings import SettingsError
from uav_ident_ros.messages.types import MessageTypeError
from uav_ident_ros.node.notices import without_sources


class UsageError(Exception):
    """The command line holds something that is not for this program."""


REFUSALS = (
    UsageError,
    SettingsError,
    MessageTypeError,
    CoefficientsFileError,
    ParameterFileError,
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    InvalidQosOverridesError,
    NameValidationException,
    rclpy_implementation.RCLError,
    rclpy_implementation.UnknownROSArgsError,
)
"""What a wrong command line, parameter or file raises before the node runs."""


def start(
    argv: Sequence[str],  # Program name and arguments
) -> None:
    """Initialise ROS with the command line; signals stay with the program's `Ending`.

    Raises
    ------
    UsageError
        If there is an argument that is not for ROS.
    RCLError
        If ROS refuses its arguments or a parameter file.
    """
    stray = remove_ros_args(list(argv))[1:]
    if stray:
        raise UsageError(
            f"unknown argument '{stray[0]}': parameters are given as "
            "--ros-args --params-file FILE, or --ros-args -p NAME:=VALUE"
        )
    # rcl logs that it failed, without saying why: `explain` says it, once.
    rclpy.logging.set_logger_level("rcl", LoggingSeverity.FATAL)
    rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
    rclpy.logging.set_logger_level("rcl", LoggingSeverity.UNSET)


def parameter_sources(
    argv: Sequence[str],  # The command line
    node: str,  # Full name of the node
) -> Iterator[str]:
    """Yield a line for each parameter file of the command line: which sections are for `node`.

    Raises
    ------
    ParameterFileError
        If a file has nothing for the node: it would run on its defaults without a word.
    """
    for option, path in itertools.pairwise(argv):
        if option == "--params-file":
            sections = ParameterFile.read(path).sections_for(node)
            if sections:
                yield f"parameters of '{path}', section {', '.join(sections)}"


def explain(
    error: Exception,  # One of `REFUSALS`
    argv: Sequence[str],  # The command line: it names the parameter files
) -> str:
    """Say in one line what is wrong and what would be right."""
    if isinstance(error, rclpy_implementation.UnknownROSArgsError):
        return f"unknown ROS arguments {error}"
    if isinstance(error, rclpy_implementation.RCLError):
        return _explain_rcl(str(error), argv)
    if isinstance(error, InvalidParameterTypeException):
        return _explain_type(str(error))
    return " ".join(str(error).split())


def _explain_type(message: str) -> str:
    """Turn what rclpy says about a parameter that it declares itself into a fix."""
    parts = re.search(r"'(.*?)' to '(.*)' of type '\w+', expecting type '(\w+)'", message)
    if parts is None:
        return message
    name, value, wanted = parts.groups()
    return f"'{name}' is {value}: {_FIXES.get(wanted, f'a {wanted} is needed')}"


_FIXES = {"BOOL": "write true or false, without quotes", "INTEGER": "write a whole number"}


def _explain_rcl(message: str, argv: Sequence[str]) -> str:
    """Turn what rcl says into what the user can mend."""
    quoted = re.search(r"'(-p|--param|--params-file) (.*?)'\. Error: (.*)", message)
    if quoted is None:
        return without_sources(message)
    option, text, reason = quoted.groups()
    if option == "--params-file":
        try:
            ParameterFile.read(text)
        except ParameterFileError as found:  # says what is wrong better than rcl does
            return str(found)
    reason = without_sources(reason)
    if "same type" in reason:
        reason += ": write every number of a list with a decimal point, like [1.0, 0.5]"
    what = "parameter file" if option == "--params-file" else "parameter"
    return f"{what} '{text}': {reason}"
