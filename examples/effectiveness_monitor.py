# SPDX-License-Identifier: Apache-2.0
"""Warn of an input with less effect than its coefficient, or a reversed one; command nothing.

``python3 examples/effectiveness_monitor.py --ros-args -p trim:="[0.07, 0.0, 0.0, 0.7]"``
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, JointState

from uav_ident_ros.client import CoefficientSource, Fallback, Refusal, subscribe
from uav_ident_ros.control import Effectiveness, Response
from uav_ident_ros.control.choice import control_derivatives
from uav_ident_ros.messages.types import FLU_TO_FRD, header_ns, xyz

AXES = ("roll", "pitch", "yaw")
WEAK = 0.6  # of the estimated effect
SIGMAS = 3.0
PERIOD = 2.0  # between warnings, s


class EffectivenessMonitor(Node):
    """Node that subscribes to gyro, actuators and coefficients."""

    def __init__(self) -> None:
        super().__init__("effectiveness_monitor")
        self.trim = np.array(self.declare_parameter("trim", [0.0, 0.0, 0.0, 0.0]).value)
        self.source = CoefficientSource(Fallback.LAST_GOOD)
        self.response, self.measured = Response(), Effectiveness()
        self.acting, self.believed, self.last_ns = np.zeros(4), np.ones(3), 0
        subscribe(self, self.source)
        self.create_subscription(JointState, "actuators", self.on_actuators, 10)
        self.create_subscription(Imu, "imu/data", self.on_imu, qos_profile_sensor_data)
        self.create_timer(PERIOD, self.warn)

    def on_actuators(self, message: JointState) -> None:
        """Store elevator, rudder, aileron and throttle."""
        self.acting = np.array(message.position) - self.trim

    def on_imu(self, message: Imu) -> None:
        """Compare the measured effect of the inputs with the coefficients."""
        t_ns = header_ns(message)
        dt, self.last_ns = (t_ns - self.last_ns) * 1e-9, t_ns
        try:
            model = self.source.model(t_ns)
        except Refusal:
            return  # no coefficients or inputs yet
        if not 0.0 < dt < 0.1:
            self.response.restart()
            self.measured.restart()
            self.believed = np.ones(3)
            return
        x = np.array(xyz(message.angular_velocity)) * FLU_TO_FRD
        effect, found = control_derivatives(model)[0], self.response
        if found.update(x, effect, self.acting[None], dt, model):
            self.measured.update(found.answered[0], found.made[0], dt, believed=self.believed)
            away = np.abs(self.measured.factor - self.believed)
            changed = away > SIGMAS * self.measured.sigma
            self.measured.begin(changed)
            self.believed = np.where(changed, self.measured.factor, self.believed)

    def warn(self) -> None:
        """Log the warnings: once in a period, since the logger takes milliseconds a call."""
        for line in warnings(self.measured):
            self.get_logger().warning(line)


def warnings(measured: Effectiveness) -> list[str]:
    """Return the warnings of all axes."""
    lines = []
    for i, axis in enumerate(AXES):
        factor, sigma = measured.since[i], measured.since_sigma[i]
        if measured.reversed[i]:
            lines.append(f"{axis}: the inputs act the other way")
        elif factor + SIGMAS * sigma < WEAK:
            lines.append(f"{axis}: the inputs do {factor:.2f} +- {sigma:.2f} of what is believed")
    return lines


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(EffectivenessMonitor())
