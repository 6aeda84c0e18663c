# SPDX-License-Identifier: Apache-2.0
"""ROS subscriptions of a controller to the topics of the identifier."""

from collections.abc import Callable
from typing import Any

import numpy as np

from uav_ident_ros.client.coefficients import Coefficients, MessageError
from uav_ident_ros.client.excitation import Excitation
from uav_ident_ros.client.source import CoefficientSource
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.published import NAMED
from uav_ident_ros.messages.types import FLU_TO_FRD, header_ns, xyz

TOPIC = f"identifier/{NAMED}"
"""Topic of the coefficients from the identifier in the node's own namespace."""

EXCITATION_TOPIC = "identifier/excitation"
"""Topic of the excitation that a controller adds."""

BURST_DEPTH = 10
"""Depth of the queue: it holds the ticks of a burst after a pause."""

COMMANDED = ("elevator", "rudder", "aileron")
"""Names in a command."""


def subscribe(
    node: Any,  # rclpy's node, the owner of the subscription
    source: CoefficientSource,  # Receiver of the messages
    topic: str = TOPIC,  # Remappings apply
    callback: Callable[[Coefficients], None] | None = None,  # Called with each set of coefficients
) -> Any:
    """Add the messages of a topic to `source`; return rclpy's subscription.

    It is reliable and latched: the last coefficients arrive at once.
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

    return node.create_subscription(JointState, topic, take, latched(BURST_DEPTH))


def subscribe_excitation(node: Any, excitation: Excitation, topic: str = EXCITATION_TOPIC) -> Any:
    """Add the messages of a topic to `excitation`; return rclpy's subscription."""
    from sensor_msgs.msg import JointState

    def take(message: JointState) -> None:
        excitation.add(header_ns(message), list(message.name), list(message.position))

    return node.create_subscription(JointState, topic, take, BURST_DEPTH)


def answer_rates(
    node: Any,  # rclpy's node, the owner of subscriptions and publisher
    # From stamp, ns, and p, q, r and their reference, rad/s, FRD, to the three surfaces, rad
    law: Callable[[int, FloatArray, FloatArray], FloatArray],
) -> None:
    """Answer each Imu on ``imu/data`` on ``command``, to the newest ``rate_reference``.

    A sample that is not finite gets no answer: the surfaces stay where they are.
    """
    from geometry_msgs.msg import Vector3Stamped
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Imu, JointState

    reference = np.zeros(3)
    commands = node.create_publisher(JointState, "command", BURST_DEPTH)

    def store(message: Vector3Stamped) -> None:
        reference[:] = xyz(message.vector)

    def answer(message: Imu) -> None:
        x = np.array(xyz(message.angular_velocity)) * FLU_TO_FRD
        if np.isfinite(x - reference).all():
            u = law(header_ns(message), x, reference.copy())
            commands.publish(JointState(header=message.header, name=COMMANDED, position=u.tolist()))

    node.create_subscription(Vector3Stamped, "rate_reference", store, BURST_DEPTH)
    node.create_subscription(Imu, "imu/data", answer, qos_profile_sensor_data)
