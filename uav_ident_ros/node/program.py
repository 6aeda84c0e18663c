# SPDX-License-Identifier: Apache-2.0
"""A node as a program: started or refused in one line, run until it is asked to end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future

from uav_ident_ros.commandline import USAGE_ERROR
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.node.startup import REFUSALS, explain, parameter_sources, start

SPIN_TIME = 0.1
"""Seconds that the executor may go on before the program looks whether it was asked to end."""

AnyNode = TypeVar("AnyNode", bound=Node)


def run(
    name: str,  # Of the program, for what it says before there is a node
    make: Callable[[], AnyNode],  # Makes the node, or raises one of `REFUSALS`
    # Lets the node work until the ending is asked for; returns the exit status
    work: Callable[[AnyNode, Ending], int],
    *,
    argv: Sequence[str],  # Command line, the program's name first
    ending: Ending,  # Takes the signals; made before the imports, which take a second
    usage: str,  # What ``--help`` prints
) -> int:
    """Run a node as a program; return its exit status: 2 if it was started wrongly."""
    if {"-h", "--help"} & set(argv[1:]):
        print(usage)
        return 0
    try:
        start(argv)
        node = make()
        for line in parameter_sources(argv, node.get_fully_qualified_name()):
            node.get_logger().info(line)
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


def spin(node: Node, ending: Ending) -> int:
    """Let `node` work until the program is asked to end; return the exit status."""
    executor = make_executor(node.get_clock().ros_time_is_active)
    executor.add_node(node)
    # The events executor's spin() never returns; with a timeout it does. Waiting for what never
    # comes, it stays in its own loop for that long, where spin_once leaves it after every message.
    while rclpy.ok() and not ending.asked:
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
