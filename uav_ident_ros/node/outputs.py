# SPDX-License-Identifier: Apache-2.0
"""The node's publishers: estimates to messages."""

from __future__ import annotations

from array import array

from geometry_msgs.msg import Vector3, Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages.published import coefficients_layout, dense_coefficients, named_entries
from uav_ident_ros.ros import RELIABLE, latched, to_stamp


class Outputs:
    """Publishes estimates."""

    def __init__(self, node: Node, structure: Structure) -> None:
        self._structure = structure
        create = node.create_publisher
        self._named = create(JointState, "~/coefficients_named", latched(1))
        self._coefficients = create(Float64MultiArray, "~/coefficients", latched(1))
        self._predicted = create(Vector3Stamped, "~/predicted_rates", RELIABLE)
        self._error = create(Vector3Stamped, "~/prediction_error", RELIABLE)
        self._layout = MultiArrayLayout(
            dim=[
                MultiArrayDimension(label=label, size=size, stride=stride)
                for label, size, stride in coefficients_layout(structure)
            ]
        )

    def publish(self, estimate: Estimate, frame_id: str) -> None:
        """Publish an estimate on every topic, stamped with its tick; rates in the Imu's frame."""
        stamp = to_stamp(estimate.t_ns)
        names, positions, efforts = named_entries(estimate, self._structure)
        self._named.publish(
            JointState(
                header=Header(stamp=stamp),
                name=list(names),
                position=_doubles(positions),
                effort=_doubles(efforts),
            )
        )
        dense = dense_coefficients(estimate, self._structure)
        self._coefficients.publish(Float64MultiArray(layout=self._layout, data=_doubles(dense)))
        header = Header(stamp=stamp, frame_id=frame_id)
        for publisher, values in (
            (self._predicted, estimate.predicted_rates),
            (self._error, estimate.prediction_error),
        ):
            x, y, z = values.tolist()
            publisher.publish(Vector3Stamped(header=header, vector=Vector3(x=x, y=y, z=z)))


def _doubles(values: FloatArray) -> array[float]:
    """Return numbers as the array type that is fastest in rclpy."""
    return array("d", values.tobytes())
