# SPDX-License-Identifier: Apache-2.0
"""Finds identifiers in the ROS graph and listens to one of them."""

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from uav_ident_ros.guest import Guest
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.monitor.heard import Heard
from uav_ident_ros.ros import latched

OUTPUT = "coefficients_named"
OUTPUT_TYPE = "sensor_msgs/msg/JointState"

DEPTH = 10
"""Depth of the queue of the coefficients."""

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
            heard.coefficients_named(
                header_ns(message), message.name, message.position, message.effort
            )

        def take_status(message: DiagnosticArray) -> None:
            for status in message.status:
                if status.name == node:
                    heard.diagnosed(status.message, {v.key: v.value for v in status.values})
                    heard.publishers = self.node.count_publishers(topic)

        subscribe = self.node.create_subscription
        subscribe(JointState, topic, take_coefficients, latched(DEPTH))
        subscribe(DiagnosticArray, "/diagnostics", take_status, STATUS_DEPTH)
        return heard
