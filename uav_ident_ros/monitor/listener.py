# SPDX-License-Identifier: Apache-2.0
"""Finds identifiers in the ROS graph and listens to one of them."""

from __future__ import annotations

import time
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from uav_ident_ros.messages.types import NS_PER_S
from uav_ident_ros.monitor.heard import Heard

OUTPUT = "coefficients_named"
OUTPUT_TYPE = "sensor_msgs/msg/JointState"

LATCHED = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""The last coefficients arrive at once."""

STATUS_DEPTH = 50
"""Depth of the queue of /diagnostics, which a whole robot shares."""

LOOK_EVERY = 0.05
"""Seconds between two looks at the graph."""

SETTLE = 3.5
"""Seconds after the first identifier is found in which others may turn up: what misses the first
announcement of a Fast DDS participant hears the next one after 3 s."""


class Listener:
    """A node of its own that listens, and publishes nothing."""

    def __init__(self) -> None:
        # A context of its own: no signal handlers, Ctrl-C stays a KeyboardInterrupt.
        self._context = Context()
        self._context.init(args=[])
        self._node = Node(
            "uav_ident_monitor",
            context=self._context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def identifiers(self) -> list[str]:
        """Full names of the identifiers that are there now, in alphabetical order."""
        return sorted(
            topic.removesuffix(f"/{OUTPUT}")
            for topic, types in self._node.get_topic_names_and_types()
            if topic.endswith(f"/{OUTPUT}")
            and OUTPUT_TYPE in types
            and self._node.count_publishers(topic) > 0
        )

    def find(
        self,
        timeout: float,  # Seconds to look at most; the list is empty if there is none by then
    ) -> list[str]:
        """Look for identifiers until some have been found, and those beside them."""
        end = time.monotonic() + timeout
        while not self.identifiers():
            if time.monotonic() > end:
                return []
            self.spin(LOOK_EVERY)
        self.spin(SETTLE)
        return self.identifiers()

    def listen(
        self,
        node: str,  # Its full name
    ) -> Heard:
        """Begin to listen to an identifier."""
        heard = Heard(node)
        self._node.create_subscription(
            JointState,
            f"{node}/{OUTPUT}",
            lambda message: _take_coefficients(message, heard),
            LATCHED,
        )
        self._node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda message: self._take_status(message, heard),
            STATUS_DEPTH,
        )
        return heard

    def _take_status(self, message: DiagnosticArray, heard: Heard) -> None:
        for status in message.status:
            if status.name == heard.node:
                heard.diagnosed(status.message, {v.key: v.value for v in status.values})
                heard.publishers = self._node.count_publishers(f"{heard.node}/{OUTPUT}")

    def spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Listen for a while, or until a condition holds; return whether it does."""
        end = time.monotonic() + seconds
        while not until():
            left = end - time.monotonic()
            if left <= 0.0:
                return False
            self._executor.spin_once(timeout_sec=min(left, LOOK_EVERY))
        return True


def _take_coefficients(message: JointState, heard: Heard) -> None:
    stamp = message.header.stamp
    heard.coefficients_named(
        stamp.sec * NS_PER_S + stamp.nanosec, message.name, message.position, message.effort
    )
