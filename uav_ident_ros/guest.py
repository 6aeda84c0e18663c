# SPDX-License-Identifier: Apache-2.0
"""Parts of the tools that observe other nodes: a node, and a /clock in step with their answers."""

import time
from collections.abc import Callable

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from uav_ident_ros.node.ending import Ending
from uav_ident_ros.ros import to_stamp

POLL_PERIOD = 0.02
"""Period for checks of a condition, and of the steps of /clock without an answer, s."""

CLOCK_AHEAD_NS = 100_000_000
"""Largest lead of /clock over unanswered messages, ns: two periods of the node's timer."""

STUCK_AFTER = 1.0
"""Time without an answer for which the lead may grow by another period of that timer, s: on a busy
machine the timer may have fired at the largest lead, before the node processed the messages."""


def listen(executor: Executor, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
    """Spin for a time or until a condition holds; return whether it holds."""
    end = time.monotonic() + seconds
    while not until():
        left = end - time.monotonic()
        if left <= 0.0:
            return False
        executor.spin_once(timeout_sec=min(left, POLL_PERIOD))
    return True


class StepClock:
    """Time of a flight that is played to a node with a timer; published on /clock on request."""

    def __init__(
        self,
        node: Node,  # Publisher of /clock
        executor: Executor,  # Executor of the node
        period_ns: int,  # Step of /clock, ns
        published: bool,
    ) -> None:
        self._executor, self._period_ns, self._ns = executor, period_ns, 0
        self.publisher = node.create_publisher(Clock, "/clock", 50) if published else None

    def send(self, t_ns: int) -> bool:
        """Publish a time; return whether it is earlier than the last one."""
        before, self._ns = self._ns, t_ns
        if self.publisher is not None:
            self.publisher.publish(Clock(clock=to_stamp(t_ns)))
        return t_ns < before

    def advance(self, t_ns: int | None = None) -> None:
        """Publish a time, by default that of the next step, if it is later than the last one."""
        t_ns = self._ns + self._period_ns if t_ns is None else t_ns
        if t_ns > self._ns:
            self.send(t_ns)

    def wait(self, answered: Callable[[], bool], t_ns: int, patience: float) -> bool:
        """Spin until the answer to the messages up to `t_ns` arrives; return whether it did.

        The node may receive a step of /clock before the messages of that time. Its timer then needs
        another step: without an answer /clock therefore advances.
        """
        begun = time.monotonic()
        while not listen(self._executor, POLL_PERIOD, answered):
            waited = time.monotonic() - begun
            if waited > patience:
                return False
            furthest_ns = t_ns + CLOCK_AHEAD_NS + int(waited / STUCK_AFTER) * CLOCK_AHEAD_NS // 2
            self.advance(min(self._ns + self._period_ns, furthest_ns))
        return True


class Guest:
    """A node in its own context, without signal handlers: Ctrl-C remains a KeyboardInterrupt."""

    def __init__(
        self,
        name: str,
        ending: Ending | None = None,  # Recorder of signals, if none may interrupt the program
    ) -> None:
        self._ending = ending
        context = Context()
        context.init(args=[])
        self.node = Node(
            name, context=context, use_global_arguments=False, enable_rosout=False,
            start_parameter_services=False,
        )  # fmt: skip
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        """Remove the node from the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        self.node.context.try_shutdown()

    def spin_for(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Spin for a time or until a condition holds; return whether it holds.

        After a signal it raises KeyboardInterrupt, between two calls of the middleware.
        """
        holds = listen(self._executor, seconds, lambda: self.end_requested() or until())
        if self.end_requested():
            raise KeyboardInterrupt
        return holds

    def end_requested(self) -> bool:
        """Return whether a signal has requested the end."""
        return self._ending is not None and self._ending.requested
