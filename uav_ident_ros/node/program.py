# SPDX-License-Identifier: Apache-2.0
"""A node as a program: started or refused in one line, run until it is asked to end."""

import itertools
import math
import re
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import rclpy
import rclpy.logging
from rclpy.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NameValidationException,
)
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from uav_ident_ros.commandline import USAGE_ERROR
from uav_ident_ros.files.coefficients_file import CoefficientsFileError
from uav_ident_ros.files.parameter_file import ParameterFile, ParameterFileError, written
from uav_ident_ros.identification.settings import Setting, SettingsError, declarations
from uav_ident_ros.messages.types import MessageTypeError
from uav_ident_ros.node.ending import Ending
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


SPIN_TIME = 0.1
"""Seconds that the executor may go on before the program looks whether it was asked to end."""

AnyNode = TypeVar("AnyNode", bound=Node)


def run(
    name: str,  # Of the program, for what it says before there is a node
    make: Callable[[], AnyNode],  # Makes the node, or raises one of `REFUSALS`
    # Lets the node work until the ending is asked for; returns the exit status
    work: Callable[[AnyNode, Ending], int],
    args: Sequence[str] | None,  # Command line, the program's name first; None for the process's
    usage: str,  # What ``--help`` prints
    ending: Ending | None = None,  # Takes the signals, if made before the imports
) -> int:
    """Run a node as a program; return its exit status: 2 if it was started wrongly."""
    argv, ending = sys.argv if args is None else args, ending or Ending()
    if {"-h", "--help"} & set(argv[1:]):
        print(usage)
        return 0
    try:
        if stray := remove_ros_args(list(argv))[1:]:
            raise UsageError(
                f"unknown argument '{stray[0]}': parameters are given as "
                "--ros-args --params-file FILE, or --ros-args -p NAME:=VALUE"
            )
        # rcl logs that it failed, without saying why: `explain` says it, once.
        rclpy.logging.set_logger_level("rcl", LoggingSeverity.FATAL)
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
        rclpy.logging.set_logger_level("rcl", LoggingSeverity.UNSET)
        node = make()
        _log_sources(node, argv)
    except REFUSALS as error:
        print(f"{name}: {explain(error, argv)}", file=sys.stderr)
        rclpy.try_shutdown()
        return USAGE_ERROR
    try:
        return work(node, ending)
    except ExternalShutdownException:
        return 0
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
        ending.close()


def _log_sources(node: Node, argv: Sequence[str]) -> None:
    """Log which sections of which parameter files are for a node; refuse a file with none."""
    for option, path in itertools.pairwise(argv):
        if option == "--params-file":
            sections = ParameterFile.read(path).sections_for(node.get_fully_qualified_name())
            if sections:
                node.get_logger().info(f"parameters of '{path}', section {', '.join(sections)}")


def spin(node: Node, ending: Ending) -> int:
    """Let `node` work until the program is asked to end; return the exit status."""
    executor = make_executor(node.get_clock().ros_time_is_active)
    executor.add_node(node)
    # The events executor's spin() never returns; with a timeout it does. Waiting for what never
    # comes, it stays in its own loop for that long, where spin_once leaves it after every message.
    while rclpy.ok() and not ending.requested:
        executor.spin_until_future_complete(Future(), timeout_sec=SPIN_TIME)
    return 0


def make_executor(simulated_time: bool) -> Executor:
    """Return the events executor, at half the cost of the other, where it can be used.

    It came with rclpy 7.1.4. When /clock moves on while a callback runs, it calls a timer once
    for every step of /clock and then pauses as many periods: under simulated time the other
    one is right.
    """
    if not simulated_time:
        try:
            from rclpy.experimental import EventsExecutor
        except ImportError:
            pass
        else:
            return EventsExecutor()
    return SingleThreadedExecutor()


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


def read_parameters(
    node: Node,  # Another node of this package
    defaults: Mapping[str, Any],  # By name; a list of numbers has as many of them
    least: Mapping[str, float],  # What numbers must not be below, by name; anything if left out
    words: Mapping[str, Sequence[str]],  # What a word may be, by name; any if left out
) -> dict[str, Any]:
    """Declare the parameters of a node; return their values by name.

    Raises
    ------
    UsageError
        If a value is not allowed; the message says what is.
    """
    values = {name: node.declare_parameter(name, v).value for name, v in defaults.items()}
    for name, value in values.items():
        several = isinstance(defaults[name], list)
        if value not in words.get(name, (value,)):
            raise UsageError(f"'{name}' is '{value}': allowed are {', '.join(words[name])}")
        if isinstance(defaults[name][0] if several else value, str):
            continue
        numbers, bound = (value or []) if several else [value], least.get(name, -math.inf)
        if several and len(numbers) != len(defaults[name]):
            raise UsageError(
                f"'{name}' has {len(numbers)} values: {len(defaults[name])} are needed"
            )
        if not all(math.isfinite(number) and number >= bound for number in numbers):
            allowed = "finite numbers" if bound == -math.inf else f"numbers from {bound:g} on"
            raise UsageError(f"'{name}' is {value}: allowed are {allowed}")
    return values


def _entry(setting: Setting) -> str:
    unit = f" {setting.unit}" if setting.unit else ""
    lines = textwrap.wrap(setting.description, 76)
    meaning = textwrap.indent("\n".join(lines), " " * 6)
    return f"  {setting.name} = {written(setting.default)}{unit}\n{meaning}"
