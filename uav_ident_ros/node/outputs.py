# SPDX-License-Identifier: Apache-2.0
"""The node's publishers: estimates to messages.

All four messages have a fixed form. They are serialized once, and then only the numbers in their
bytes are written anew.
"""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Vector3, Vector3Stamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages.cdr import Template
from uav_ident_ros.messages.types import (
    coefficients_layout,
    dense_coefficients,
    entry_names,
    named_entries,
)

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
    """

    def __init__(self, node: Node, structure: Structure) -> None:
        self._structure = structure
        create = node.create_publisher
        self._named = create(JointState, "~/coefficients_named", LATCHED)
        self._coefficients = create(Float64MultiArray, "~/coefficients", LATCHED)
        self._predicted = create(Vector3Stamped, "~/predicted_rates", RELIABLE)
        self._error = create(Vector3Stamped, "~/prediction_error", RELIABLE)
        self._named_form = _named_form(structure)
        self._dense_form = _dense_form(structure)
        self._frame_id = ""
        self._vector_form = _vector_form(self._frame_id)

    def publish(self, estimate: Estimate, frame_id: str) -> None:
        """Publish an estimate on every topic, stamped with its tick.

        Parameters
        ----------
        estimate : Estimate
            What to publish.
        frame_id : str
            Frame of its rates: that of the Imu's messages.
        """
        if frame_id != self._frame_id:
            self._frame_id = frame_id
            self._vector_form = _vector_form(frame_id)
        entries = named_entries(estimate, self._structure)
        self._named_form.stamp(estimate.t_ns)
        self._vector_form.stamp(estimate.t_ns)
        vector = self._vector_form.filled
        self._named.publish(self._named_form.filled(entries.positions, entries.efforts))
        self._coefficients.publish(
            self._dense_form.filled(dense_coefficients(estimate, self._structure))
        )
        self._predicted.publish(vector(estimate.predicted_rates))
        self._error.publish(vector(estimate.prediction_error))


def _marks(count: int, first: int = 1) -> FloatArray:
    """Numbers to find a place in a message by: no length or label has their bytes."""
    return np.pi * np.arange(first, first + count)


def _named_form(structure: Structure) -> Template:
    names = list(entry_names(structure))
    positions, efforts = _marks(len(names)), _marks(len(names), first=1 + len(names))
    message = JointState(name=names, position=positions.tolist(), effort=efforts.tolist())
    return Template(message, (positions, efforts))


def _dense_form(structure: Structure) -> Template:
    data = _marks(len(structure.dense_rows) * structure.size)
    layout = MultiArrayLayout(
        dim=[
            MultiArrayDimension(label=label, size=size, stride=stride)
            for label, size, stride in coefficients_layout(structure)
        ]
    )
    return Template(Float64MultiArray(layout=layout, data=data.tolist()), (data,))


def _vector_form(frame_id: str) -> Template:
    mark = _marks(3)
    x, y, z = mark.tolist()
    message = Vector3Stamped(header=Header(frame_id=frame_id), vector=Vector3(x=x, y=y, z=z))
    return Template(message, (mark,))
