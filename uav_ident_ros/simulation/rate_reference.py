# SPDX-License-Identifier: Apache-2.0
"""The node `rate_reference`: rates for a controller to follow, as in normal flight.

It banks to one side and the other and pitches up and down, by random amounts at random times, and
asks for the rates that lead there; nothing is added to excite anything.
"""

import math
import sys
from typing import Any

from geometry_msgs.msg import Quaternion, Vector3, Vector3Stamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from uav_ident_ros.messages.types import NS_PER_S, header_ns
from uav_ident_ros.node.program import node_usage, read_parameters, run, spin
from uav_ident_ros.simulation.manoeuvres import Manoeuvres

PARAMETERS: dict[str, Any] = {
    "bank": 0.5,  # rad
    "pitch": 0.1,  # rad
    "hold": [2.0, 4.0],  # s
    "airspeed": 53.0,  # m/s
    "seed": 0,
}
"""Parameters and their defaults."""

LEAST = {"hold": 0.0, "airspeed": 1.0, "seed": 0.0}
"""What they must not be below."""


def attitude(q: Quaternion) -> tuple[float, float]:
    """Roll and pitch, rad, FRD, from an orientation in REP-103 axes."""
    roll = math.atan2(2.0 * (q.w * q.x + q.y * q.z), 1.0 - 2.0 * (q.x**2 + q.y**2))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (q.w * q.y - q.z * q.x))))
    return roll, -pitch


class RateReference(Node):
    """The node: answers each Imu message with a reference of the same stamp."""

    def __init__(self) -> None:
        super().__init__("rate_reference")
        value = read_parameters(self, PARAMETERS, LEAST, {})
        low, high = value.pop("hold")
        self._manoeuvres = Manoeuvres(hold=(low, high), **value)
        self._first_ns = self._last_ns = 0
        reliable = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._publisher = self.create_publisher(Vector3Stamped, "rate_reference", reliable)
        self.create_subscription(Imu, "imu/data", self._on_imu, best_effort)

    def _on_imu(self, message: Imu) -> None:
        t_ns = header_ns(message)
        if not self._last_ns < t_ns:
            self._first_ns = self._last_ns = t_ns
        self._first_ns = self._first_ns or t_ns
        roll, pitch = attitude(message.orientation)
        since, dt = (t_ns - self._first_ns) / NS_PER_S, (t_ns - self._last_ns) / NS_PER_S
        self._last_ns = t_ns
        p, q, r = self._manoeuvres.rates(since, roll, pitch, dt).tolist()
        self._publisher.publish(
            Vector3Stamped(
                header=Header(stamp=message.header.stamp, frame_id="base_link_frd"),
                vector=Vector3(x=p, y=q, z=r),
            )
        )


def main(args: list[str] | None = None) -> int:
    """Run the node; the return value is the exit status."""
    usage = node_usage("rate_reference", __doc__ or "", PARAMETERS)
    return run("rate_reference", RateReference, spin, args, usage)


if __name__ == "__main__":
    sys.exit(main())
