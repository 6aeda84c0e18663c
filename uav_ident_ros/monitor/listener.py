# SPDX-License-Identifier: Apache-2.0
"""Finds identifiers in the ROS graph and listens to one of them."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from uav_ident_ros.guest import Guest
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

SETTLE = 3.5
"""Seconds after the first identifier is found in which others may turn up: what misses the first
announcement of a Fast DDS participant hears the next one after 3 s."""


class Listener(Guest):
    """A node of its own that listens, and publishes nothing."""

    def __init__(self) -> None:
        super().__init__("uav_ident_monitor", start_parameter_services=False)

    def identifiers(self) -> list[str]:
        """Full names of the identifiers that are there now, in alphabetical order."""
        return sorted(
            topic.removesuffix(f"/{OUTPUT}")
            for topic, types in self.node.get_topic_names_and_types()
            if topic.endswith(f"/{OUTPUT}")
            and OUTPUT_TYPE in types
            and self.node.count_publishers(topic) > 0
        )

    def find(
        self,
        timeout: float,  # Seconds to look at most; the list is empty if there is none by then
    ) -> list[str]:
        """Look for identifiers until some have been found, and those beside them."""
        if not self.spin_for(timeout, lambda: bool(self.identifiers())):
            return []
        self.spin_for(SETTLE)
        return self.identifiers()

    def listen(
        self,
        node: str,  # Its full name
    ) -> Heard:
        """Begin to listen to an identifier."""
        heard, topic = Heard(node), f"{node}/{OUTPUT}"

        def take_coefficients(message: JointState) -> None:
            stamp = message.header.stamp
            t_ns = stamp.sec * NS_PER_S + stamp.nanosec
            heard.coefficients_named(t_ns, message.name, message.position, message.effort)

        def take_status(message: DiagnosticArray) -> None:
            for status in message.status:
                if status.name == node:
                    heard.diagnosed(status.message, {v.key: v.value for v in status.values})
                    heard.publishers = self.node.count_publishers(topic)

        subscribe = self.node.create_subscription
        subscribe(JointState, topic, take_coefficients, LATCHED)
        subscribe(DiagnosticArray, "/diagnostics", take_status, STATUS_DEPTH)
        return heard
