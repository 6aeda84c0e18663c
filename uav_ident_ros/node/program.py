# SPDX-License-Identifier: Apache-2.0
"""A node as a program: one line on a wrong start, an orderly end on a signal."""

import itertools
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import rclpy
import rclpy.logging
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from uav_ident_ros.commandline import BROKEN_PIPE, USAGE_ERROR, reader_has_gone
from uav_ident_ros.files.coefficients_file import CoefficientsFileError
from uav_ident_ros.files.parameter_file import ParameterFile, ParameterFileError, written
from uav_ident_ros.identification.settings import Setting, SettingsError, nearest
from uav_ident_ros.messages.types import MessageTypeError
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.node.notices import without_sources


class UsageError(Exception):
    """The command line has an unknown argument."""


REFUSALS = (
    UsageError,
    SettingsError,
    MessageTypeError,
    CoefficientsFileError,
    ParameterFileError,
    ParameterException,
    InvalidQosOverridesError,
    NameValidationException,
    rclpy_implementation.RCLError,
    rclpy_implementation.UnknownROSArgsError,
)
"""Exceptions of a wrong command line, parameter or file before the node runs."""


def explain(error: Exception) -> str:
    """Return one line with problem and cure for one of `REFUSALS`."""
    message = without_sources(str(error))
    if isinstance(error, rclpy_implementation.UnknownROSArgsError):
        return f"unknown ROS arguments {message}"
    # a parameter that rclpy declares itself
    typed = re.search(r"'(.*?)' to '(.*)' of type '\w+', expecting type '(\w+)'", message)
    if typed:
        name, value, wanted = typed.groups()
        return f"'{name}' is {value}: {_FIXES.get(wanted, f'a {wanted} is needed')}"
    quoted = re.search(r"'(-p|--param|-r|--remap|--params-file) (.*?)'\. Error: (.*)", message)
    if quoted is None:
        return message
    option, text, reason = quoted.groups()
    if option == "--params-file":
        try:
            ParameterFile.read(text)
        except ParameterFileError as found:  # has a clearer text than the error of rcl
            return str(found)
    what = {"--params-file": "parameter file", "-r": "remapping", "--remap": "remapping"}.get(
        option, "parameter"
    )
    if "same type" in reason:
        reason += ": write every number of a list with a decimal point, like [1.0, 0.5]"
    elif re.search("lexeme|token|not set", reason):  # of the grammar of rcl, or an empty side
        reason = f"write {'FROM:=TO' if what == 'remapping' else 'NAME:=VALUE'}"
    return f"{what} '{text}': {reason}"


_FIXES = {"BOOL": "write true or false, without quotes", "INTEGER": "write a whole number"}


SPIN_TIME = 0.1
"""Interval at which the program checks for a request to end, s."""

AnyNode = TypeVar("AnyNode", bound=Node)


def run(
    name: str,  # Name of the program, for errors before there is a node
    make: Callable[[], AnyNode],  # Makes the node, or raises one of `REFUSALS`
    # Runs the node until the end is requested; returns the exit status
    work: Callable[[AnyNode, Ending], int],
    args: Sequence[str] | None,  # Command line, the program's name first; None for the process's
    text: str | None,  # Description for ``--help``
    settings: Iterable[Setting],  # The parameters, for the same
    ending: Ending | None = None,  # Handler of signals, if made before the imports
) -> int:
    """Run a node as a program; return its exit status: 2 after a wrong start."""
    argv, ending = sys.argv if args is None else args, ending or Ending()
    if {"-h", "--help"} & set(argv[1:]):
        with suppress(BrokenPipeError):
            print(_usage(name, text or "", settings), flush=True)
            return 0
        reader_has_gone()
        return BROKEN_PIPE
    try:
        if stray := remove_ros_args(list(argv))[1:]:
            raise UsageError(
                f"unknown argument '{stray[0]}': parameters are given as "
                "--ros-args --params-file FILE, or --ros-args -p NAME:=VALUE"
            )
        # The log line of rcl has no reason; `explain` gives it.
        rclpy.logging.set_logger_level("rcl", LoggingSeverity.FATAL)
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
        rclpy.logging.set_logger_level("rcl", LoggingSeverity.UNSET)
        node = make()
        _log_sources(node, argv)
    except REFUSALS as error:
        print(f"{name}: {explain(error)}", file=sys.stderr)
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
    """Log the sections of parameter files for a node, and doubts; raise if a file has none."""
    for option, path in itertools.pairwise(argv):
        if option == "--params-file":
            file, name = ParameterFile.read(path), node.get_fully_qualified_name()
            if sections := file.sections_for(name):
                node.get_logger().info(f"parameters of '{path}', section {', '.join(sections)}")
            for doubt in file.doubts(name):
                node.get_logger().warning(doubt)


def spin(node: Node, ending: Ending) -> int:
    """Run `node` until the end is requested; return the exit status."""
    executor = make_executor(node.get_clock().ros_time_is_active)
    executor.add_node(node)
    # The events executor's spin() never returns, and spin_once returns after every message.
    # Waiting with a timeout for a future that is never done keeps it in its own loop.
    while rclpy.ok() and not ending.requested:
        executor.spin_until_future_complete(Future(), timeout_sec=SPIN_TIME)
    return 0


def make_executor(simulated_time: bool) -> Executor:
    """Return the events executor, at half the processor load, unless time is simulated.

    It exists since rclpy 7.1.4. If /clock advances during a callback, it calls a timer once per
    step of /clock and then pauses as many periods. Under simulated time the single-threaded
    executor is used.
    """
    if not simulated_time:
        try:
            from rclpy.experimental import EventsExecutor
        except ImportError:
            pass
        else:
            return EventsExecutor()
    return SingleThreadedExecutor()


USAGE = """\
usage: {} [--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r FROM:=TO] ...]

{}

parameters, with their defaults:
{}"""


def _usage(name: str, text: str, settings: Iterable[Setting]) -> str:
    """Return the text of ``--help``: usage, description, every parameter."""
    entries = []
    for setting in settings:
        unit = f" {setting.unit}" if setting.unit else ""
        meaning = textwrap.indent(textwrap.fill(setting.description, 76), " " * 6)
        entries.append(f"  {setting.name} = {written(setting.default)}{unit}\n{meaning}")
    return USAGE.format(name, text.strip(), "\n".join(entries))


def read_parameters(
    node: Node,  # Any node of this package but the identifier
    settings: Sequence[Setting],  # A list of numbers must be as long as its default
) -> dict[str, Any]:
    """Declare the parameters of a node; return their values by name.

    Raises
    ------
    SettingsError
        If a value is not allowed; the message has the allowed ones.
    """
    values: dict[str, Any] = {}
    known = [setting.name for setting in settings]
    for name in node._parameter_overrides:  # as in `parameters.settings_of`
        # others may belong to another node, in a section /**
        if name not in known and (hint := nearest(name, known)):
            node.get_logger().warning(f"there is no parameter '{name}': {hint}")
    for setting in settings:
        name, default = setting.name, setting.default
        plain: Any = list(default) if isinstance(default, tuple) else default
        value = values[name] = node.declare_parameter(name, plain).value
        setting.check(value)
        if setting.type == "float[]" and len(value) != len(plain):
            raise SettingsError(f"'{name}' has {len(value)} values: {len(plain)} are needed")
    return values
