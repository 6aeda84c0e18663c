# SPDX-License-Identifier: Apache-2.0
"""The node's publishers: estimates to messages.

Every scalar goes through float(): an int, a bool or a NumPy scalar in a float64 field would be
published as garbage, without an exception.
"""

from __future__ import annotations

from array import array

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3, Vector3Stamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages import NS_PER_S, coefficients_layout, entry_names, named_entries

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""A late subscriber gets the last coefficients at once."""

RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


class Outputs:
    """Publishes estimates.

    Parameters
    ----------
    node : Node
        Owner of the publishers.
    structure : Structure
        Structure of the estimates.

    Attributes
    ----------
    frame_id : str
        Frame of the predicted rates: that of the Imu's messages.
    """

    def __init__(self, node: Node, structure: Structure) -> None:
        self._structure = structure
        self.frame_id = ""
        create = node.create_publisher
        self._named = create(JointState, "~/coefficients_named", LATCHED)
        self._coefficients = create(Float64MultiArray, "~/coefficients", LATCHED)
        self._predicted = create(Vector3Stamped, "~/predicted_rates", RELIABLE)
        self._error = create(Vector3Stamped, "~/prediction_error", RELIABLE)
        self._layout = MultiArrayLayout(
            dim=[
                MultiArrayDimension(label=label, size=size, stride=stride)
                for label, size, stride in coefficients_layout(structure)
            ]
        )
        self._names = list(entry_names(structure))

    def publish(self, estimate: Estimate) -> None:
        """Publish an estimate on every topic, stamped with its tick."""
        stamp = Time(sec=estimate.t_ns // NS_PER_S, nanosec=estimate.t_ns % NS_PER_S)
        entries = named_entries(estimate, self._structure)
        self._named.publish(
            JointState(
                header=Header(stamp=stamp),
                name=self._names,
                position=_doubles(entries.positions),
                effort=_doubles(entries.efforts),
            )
        )
        self._coefficients.publish(
            Float64MultiArray(layout=self._layout, data=_doubles(estimate.coefficients))
        )
        header = Header(stamp=stamp, frame_id=self.frame_id)
        self._predicted.publish(
            Vector3Stamped(header=header, vector=_vector(estimate.predicted_rates))
        )
        self._error.publish(
            Vector3Stamped(header=header, vector=_vector(estimate.prediction_error))
        )


def _doubles(values: FloatArray) -> array[float]:
    """Row-major float64 values: several times quicker into a message than an ndarray."""
    return array("d", values.tobytes())


def _vector(values: FloatArray) -> Vector3:
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))
