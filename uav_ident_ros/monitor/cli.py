# SPDX-License-Identifier: Apache-2.0
"""The command `monitor`: watch a running identifier from a terminal, over ssh too."""

import argparse
import math
import sys
from contextlib import closing
from typing import NoReturn

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_full_topic_name import validate_full_topic_name

from uav_ident_ros.client import CoefficientSource, Fallback, subscribe
from uav_ident_ros.commandline import (
    INTERRUPTED,
    NOT_USABLE,
    USABLE,
    USAGE_ERROR,
    OneLineParser,
    number,
    reader_has_gone,
)
from uav_ident_ros.guest import Guest
from uav_ident_ros.messages.published import NAMED
from uav_ident_ros.monitor.watched_node import WatchedNode
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.ros import domain

STATUS_DEPTH = 50
"""Depth of the queue of /diagnostics, which all nodes of a robot share."""

OTHERS_TIME = 3.5
"""Seconds to wait for other identifiers after the first one: a lost announcement of a Fast DDS
participant is repeated after 3 s."""

NOTHING_RECEIVED = 3
"""Exit status of ``--once`` beside those of the verdict; the view itself ends with 0."""

TIMEOUT = 5.0
"""Timeout of ``--once``, s: five statuses of the node, since discovery is slow."""

LOOK_AGAIN = 1.0
"""Interval of the search for an identifier, s."""


class MonitorError(Exception):
    """There is no identifier, or several; the arguments are a message and the exit status."""


def identifiers(guest: Guest) -> list[str]:
    """Return the full names of the identifiers that publish now, sorted."""
    return sorted(
        topic.removesuffix(f"/{NAMED}")
        for topic, _ in guest.node.get_topic_names_and_types()
        if topic.endswith(f"/{NAMED}") and guest.node.count_publishers(topic) > 0
    )


def find(
    guest: Guest,
    timeout: float,  # Longest time of the search, s
) -> str:
    """Return the full name of the only identifier, empty if none; raises `MonitorError`."""
    if not guest.spin_for(timeout, lambda: bool(identifiers(guest))):
        return ""
    guest.spin_for(OTHERS_TIME)
    found = identifiers(guest)
    if len(found) > 1:
        several = f"there are {len(found)} identifiers: choose one with --node"
        raise MonitorError("\n  ".join([several, *found]), USAGE_ERROR)
    return found[0] if found else ""


def discover(guest: Guest, node: str) -> WatchedNode:
    """Subscribe to the topics of an identifier, by its full name."""
    watched, topic = WatchedNode(node), f"{node}/{NAMED}"

    def take_status(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == node:
                watched.diagnosed(status.message, {v.key: v.value for v in status.values})
                watched.publishers = guest.node.count_publishers(topic)

    subscribe(guest.node, CoefficientSource(Fallback.REFUSE), topic, watched.take)
    guest.node.create_subscription(DiagnosticArray, "/diagnostics", take_status, STATUS_DEPTH)
    return watched


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = OneLineParser(
        prog="monitor",
        description="Watch a running identifier: coefficients with sigma, t-ratio and trend, "
        "fit, state, verdict, inputs and delay. Ctrl-C ends it.",
        epilog="--once exits with 0 if the coefficients may be used, 1 if not, 2 if the command "
        "line is wrong or there are several nodes, 3 if no identifier was found, 130 after Ctrl-C.",
    )
    result.add_argument("--node", type=_full_name,
        help="full name of the node, like /drone1/identifier (the only one there is)")  # fmt: skip
    result.add_argument("--plain", action="store_true",
        help="a block of text every second, as where there is no terminal")  # fmt: skip
    result.add_argument("--once", action="store_true", help="print one block and exit")
    positive = ": a positive number of seconds is needed"
    seconds = number(float, math.ulp(0.0), sys.float_info.max, positive)
    result.add_argument("--timeout", type=seconds, default=TIMEOUT,
        help=f"seconds that --once waits for the node at most ({TIMEOUT:g})")  # fmt: skip
    return result


def _full_name(text: str) -> str:
    name = text.rstrip("/")
    name = name if name.startswith("/") else f"/{name}"
    try:
        validate_full_topic_name(name)
    except InvalidTopicNameException:
        raise argparse.ArgumentTypeError(f"'{text}' is no node name: write /identifier") from None
    return name


def once(guest: Guest, node: str | None, timeout: float) -> int:
    """Print one block; return the exit status, which depends on the verdict."""
    from uav_ident_ros.monitor.picture import View  # before it subscribes: messages would grow old

    node = node or find(guest, timeout)
    if not node:
        problem = f"no identifier was found for {timeout:g} s: does one run, {domain()}?"
        raise MonitorError(problem, NOTHING_RECEIVED)
    watched = discover(guest, node)
    guest.spin_for(timeout, lambda: watched.fresh and bool(watched.state))
    if watched.newest is None and not watched.state:
        others = ", ".join(identifiers(guest))
        there = f"; running: {others}" if others else f": does it run, {domain()}?"
        raise MonitorError(f"no message of '{node}' for {timeout:g} s{there}", NOTHING_RECEIVED)
    View(plain=True).show(watched)
    return USABLE if watched.usable else NOT_USABLE


def watch(guest: Guest, node: str | None, plain: bool) -> NoReturn:
    """Show an identifier until Ctrl-C; wait for one if there is none."""
    from uav_ident_ros.monitor.picture import View

    if not node:
        print("monitor: looking for an identifier (Ctrl-C ends it)", file=sys.stderr)
    while not node:
        node = find(guest, LOOK_AGAIN)
    watched = discover(guest, node)
    with closing(View(plain)) as view:
        while True:
            view.show(watched)
            guest.spin_for(view.period)


def main(arguments: list[str] | None = None) -> int:
    """Run the monitor; the return value is the exit status."""
    options = parser().parse_args(arguments)
    ending = Ending()  # before anything that needs cleaning up
    guest = Guest("uav_ident_monitor", ending)
    try:
        if options.once:
            return once(guest, options.node, options.timeout)
        watch(guest, options.node, options.plain)
    except MonitorError as error:
        problem, status = error.args
        print(f"monitor: {problem}", file=sys.stderr)
        return int(status)
    except KeyboardInterrupt:
        return INTERRUPTED if options.once else 0
    except BrokenPipeError:
        reader_has_gone()
        return 0
    finally:
        guest.close()
        ending.close()
