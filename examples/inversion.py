# SPDX-License-Identifier: Apache-2.0
"""Inversion of the identified model, with a disturbance observer.

``python3 examples/inversion.py --ros-args -p nominal_file:=coefficients.yaml``
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import rclpy
from geometry_msgs.msg import Vector3Stamped
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, JointState

from uav_ident_ros.client import Coefficients, CoefficientSource, Fallback, History, subscribe
from uav_ident_ros.control import InversionLaw
from uav_ident_ros.control.allocation import authority
from uav_ident_ros.control.choice import control_derivatives

FLU_TO_FRD = np.array([1.0, -1.0, -1.0])
LIMITS = np.array([[-0.4, -0.25, -0.25, 0.0], [0.4, 0.25, 0.25, 0.0]])  # de dr da dth, from trim
DELAY_NS = 20_000_000  # from a sample to the action of its command


class Inversion(Node):
    """Rates in, surfaces out."""

    def __init__(self) -> None:
        super().__init__("inversion")
        nominal = Coefficients.from_file(self.declare_parameter("nominal_file", "").value)
        self.source = CoefficientSource(Fallback.LAST_GOOD, nominal)
        subscribe(self, self.source)
        self.law = InversionLaw(LIMITS, authority(control_derivatives(nominal)[0], LIMITS))
        self.sent: History[NDArray[np.float64]] = History()
        self.reference = np.zeros(3)
        self.last_ns = 0
        self.publisher = self.create_publisher(JointState, "command", 10)
        self.create_subscription(Vector3Stamped, "rate_reference", self.on_reference, 10)
        self.create_subscription(Imu, "imu/data", self.on_imu, qos_profile_sensor_data)

    def on_reference(self, message: Vector3Stamped) -> None:
        """Store the reference."""
        self.reference = np.array([message.vector.x, message.vector.y, message.vector.z])

    def on_imu(self, message: Imu) -> None:
        """Publish the command to a sample."""
        t_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        w = message.angular_velocity
        x = np.array([w.x, w.y, w.z]) * FLU_TO_FRD
        if not np.isfinite(x - self.reference).all():  # hold the surfaces
            return
        model = self.source.model(t_ns)  # the identified, last good or nominal set
        effect = control_derivatives(model)[0]
        dt, self.last_ns = (t_ns - self.last_ns) * 1e-9, t_ns
        if not 0.0 < dt < 0.1:  # the first sample, or a gap
            self.law.restart(model, effect, x, self.reference)
            dt = 0.0
        acting = self.sent.at(t_ns - DELAY_NS)
        acting = np.zeros(4) if acting is None else acting
        u = self.law.update(dt, model, effect, x, self.reference, acting)
        self.sent.add(t_ns, u)
        names = ["elevator", "rudder", "aileron"]
        self.publisher.publish(
            JointState(header=message.header, name=names, position=u[:3].tolist())
        )


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Inversion())
