# SPDX-License-Identifier: Apache-2.0
"""The lines of ROS that a controller needs: one for each topic of the identifier."""

from collections.abc import Callable
from typing import Any

from uav_ident_ros.client.coefficients import Coefficients, MessageError
from uav_ident_ros.client.excitation import Excitation
from uav_ident_ros.client.source import CoefficientSource
from uav_ident_ros.messages.types import header_ns

TOPIC = "identifier/coefficients_named"
"""Where the identifier of the node's own namespace publishes."""

EXCITATION_TOPIC = "identifier/excitation"
"""Where it publishes what a controller is asked to add."""

DEPTH = 10
"""Depth of the queue: ticks that come in a burst, after a pause, are not lost."""


def subscribe(
    node: Any,  # rclpy's, the owner of the subscription
    source: CoefficientSource,  # What takes the messages
    topic: str = TOPIC,  # Remappings apply
    callback: Callable[[Coefficients], None] | None = None,  # Told the coefficients of each message
) -> Any:
    """Feed `source` from a topic; return rclpy's subscription.

    It is reliable and latched, so that the last coefficients come at once.
    """
    from sensor_msgs.msg import JointState

    from uav_ident_ros.ros import latched

    def take(message: JointState) -> None:
        try:
            coefficients = source.take(message)
        except MessageError as error:
            node.get_logger().error(f"{topic}: {error}", throttle_duration_sec=5.0)
            return
        if callback is not None:
            callback(coefficients)

    return node.create_subscription(JointState, topic, take, latched(DEPTH))


def subscribe_excitation(node: Any, excitation: Excitation, topic: str = EXCITATION_TOPIC) -> Any:
    """Feed `excitation` from a topic, as `subscribe` does a source of coefficients."""
    from sensor_msgs.msg import JointState

    def take(message: JointState) -> None:
        excitation.add(header_ns(message), list(message.name), list(message.position))

    return node.create_subscription(JointState, topic, take, DEPTH)
