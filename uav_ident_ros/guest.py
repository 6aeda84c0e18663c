# SPDX-License-Identifier: Apache-2.0
"""Listening to others: a node for tools that do, and a /clock that waits for their answers."""

import time
from collections.abc import Callable

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from uav_ident_ros.node.ending import Ending
from uav_ident_ros.ros import to_stamp

LOOK_EVERY = 0.02
"""Seconds between two looks at a condition, and without an answer until /clock goes on a step."""

CLOCK_AHEAD_NS = 100_000_000
"""How far /clock may get ahead of the messages that way, ns: two periods of the node's timer."""

STUCK_AFTER = 1.0
"""Seconds without an answer after which /clock may get ahead by another period of that timer: on a
busy machine the timer may have fired at the furthest time, before the messages were looked at."""


def listen(executor: Executor, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
    """Listen for a while, or until a condition holds; return whether it does."""
    end = time.monotonic() + seconds
    while not until():
        left = end - time.monotonic()
        if left <= 0.0:
            return False
        executor.spin_once(timeout_sec=min(left, LOOK_EVERY))
    return True


class StepClock:
    """The time of a flight that is played to a node with a timer, on /clock if that is wanted."""

    def __init__(
        self,
        node: Node,  # Who publishes it
        executor: Executor,  # Who listens for it
        period_ns: int,  # Of its steps, ns
        published: bool,
    ) -> None:
        self._executor, self._period_ns, self._ns = executor, period_ns, 0
        self.publisher = node.create_publisher(Clock, "/clock", 50) if published else None

    def send(self, t_ns: int) -> bool:
        """Publish a time, even one before the last; return whether it is."""
        before, self._ns = self._ns, t_ns
        if self.publisher is not None:
            self.publisher.publish(Clock(clock=to_stamp(t_ns)))
        return t_ns < before

    def advance(self, t_ns: int | None = None) -> None:
        """Publish a time, by default that of the next step, if it is later than the last."""
        t_ns = self._ns + self._period_ns if t_ns is None else t_ns
        if t_ns > self._ns:
            self.send(t_ns)

    def wait(self, answered: Callable[[], bool], t_ns: int, patience: float) -> bool:
        """Listen for the answer to what was played until `t_ns`; return whether it came.

        The node may have seen /clock pass before the messages that came with it, and then its timer
        waits for the next step of /clock: after a while it gets one.
        """
        begun = time.monotonic()
        while not listen(self._executor, LOOK_EVERY, answered):
            waited = time.monotonic() - begun
            if waited > patience:
                return False
            furthest_ns = t_ns + CLOCK_AHEAD_NS + int(waited / STUCK_AFTER) * CLOCK_AHEAD_NS // 2
            self.advance(min(self._ns + self._period_ns, furthest_ns))
        return True


class Guest:
    """A node in a context of its own: without signal handlers Ctrl-C stays a KeyboardInterrupt."""

    def __init__(
        self,
        name: str,
        ending: Ending | None = None,  # Takes the signals, where others must not be interrupted
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
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        self.node.context.try_shutdown()

    def spin_for(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Listen for a while, or until a condition holds; return whether it does.

        A signal interrupts it here, and not in the middle of the middleware's work.
        """
        holds = listen(self._executor, seconds, lambda: self.called_off() or until())
        if self.called_off():
            raise KeyboardInterrupt
        return holds

    def called_off(self) -> bool:
        """Whether a signal asks for the end."""
        return self._ending is not None and self._ending.requested
