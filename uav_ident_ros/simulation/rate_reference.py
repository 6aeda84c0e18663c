# SPDX-License-Identifier: Apache-2.0
"""The node `rate_reference`: rates for a controller to follow, as in normal flight.

The bank angle alternates between the sides and the pitch angle changes, by random amounts at
random times. The reference contains no excitation.
"""

import math
import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import Quaternion, Vector3, Vector3Stamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.settings import Setting
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import NS_PER_S, header_ns
from uav_ident_ros.node.program import read_parameters, run, spin

RATE_PER_ANGLE = 1.0
"""Reference rate per rad of angle error, 1/s."""

SMOOTHING = 0.2
"""Time constant of the reference rates, s: those of a pilot are no steps."""

MAX_RATES = (0.35, 0.15)
"""Largest rates of bank and pitch angle, rad/s (20 and 9 deg/s)."""

STEADY_TIME = 2.0
"""Time of straight flight at the start, s."""

LEAST_BANK = 0.4
"""Smallest bank as a fraction of the largest."""


class Manoeuvres:
    """Random bank and pitch angles, and the rates that track them."""

    def __init__(
        self,
        bank: float,  # bank, pitch: Largest bank angle, and largest change of the pitch angle, rad
        pitch: float,
        hold: tuple[float, float],  # Shortest and longest time between changes, s
        airspeed: float,  # For coordinated turns, m/s
        seed: int,  # Seed of the angles and times
    ) -> None:
        self._bank, self._pitch, self._hold, self._airspeed = bank, pitch, hold, airspeed
        self._rng = np.random.default_rng(seed)
        self._target = [0.0, 0.0]  # bank; pitch relative to the initial one
        self._next = [STEADY_TIME, STEADY_TIME]
        self._side = 1.0
        self._level: float | None = None
        self._rates: FloatArray = np.zeros(2)

    def rates(
        self,
        time: float,  # After the first call, s
        roll: float,  # roll, pitch: Attitude, rad, FRD
        pitch: float,
        dt: float,  # Time since the last call, s
    ) -> FloatArray:
        """Return the reference of p, q, r, rad/s, FRD."""
        if self._level is None:
            self._level = pitch
        self._choose(time)
        error = np.array([self._target[0] - roll, self._level + self._target[1] - pitch])
        wanted = np.clip(RATE_PER_ANGLE * error, np.negative(MAX_RATES), MAX_RATES)
        self._rates = self._rates + min(1.0, dt / SMOOTHING) * (wanted - self._rates)
        return body_rates(self._rates, roll, pitch, GRAVITY / self._airspeed * math.tan(roll))

    def _choose(self, time: float) -> None:
        for i in range(2):
            if time >= self._next[i]:
                self._next[i] = time + self._rng.uniform(*self._hold)
                if i == 0:
                    size = self._bank * self._rng.uniform(LEAST_BANK, 1.0)
                    self._target[0], self._side = self._side * size, -self._side
                else:
                    self._target[1] = self._pitch * self._rng.uniform(-1.0, 1.0)


def body_rates(angle_rates: FloatArray, roll: float, pitch: float, turn: float) -> FloatArray:
    """Return p, q, r for rates of bank, pitch (angle_rates) and heading (turn), rad/s."""
    bank_rate, pitch_rate = angle_rates
    return np.array(
        [
            bank_rate - turn * math.sin(pitch),
            pitch_rate * math.cos(roll) + turn * math.cos(pitch) * math.sin(roll),
            -pitch_rate * math.sin(roll) + turn * math.cos(pitch) * math.cos(roll),
        ]
    )


PARAMETERS = (
    Setting("bank", "float", 0.5, "rad", "Largest bank angle."),
    Setting("pitch", "float", 0.1, "rad", "Largest change of the pitch angle."),
    Setting("hold", "float[]", (2.0, 4.0), "s", "Shortest and longest time between changes.", 0.0),
    Setting("airspeed", "float", 53.0, "m/s", "For coordinated turns.", 1.0),
    Setting("seed", "int", 0, "", "Seed of the angles and times.", 0.0),
)

NORMAL: dict[str, Any] = {setting.name: setting.default for setting in PARAMETERS}
"""Default values of the manoeuvres."""


def attitude(q: Quaternion) -> tuple[float, float]:
    """Return roll and pitch, rad, FRD, for an orientation in REP-103 axes."""
    roll = math.atan2(2.0 * (q.w * q.x + q.y * q.z), 1.0 - 2.0 * (q.x**2 + q.y**2))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (q.w * q.y - q.z * q.x))))
    return roll, -pitch


class RateReference(Node):
    """The node: publishes a reference for each Imu message, with the same stamp."""

    def __init__(self) -> None:
        super().__init__("rate_reference")
        self._value = read_parameters(self, PARAMETERS)
        self._last_ns = sys.maxsize
        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._publisher = self.create_publisher(Vector3Stamped, "rate_reference", 50)
        self.create_subscription(Imu, "imu/data", self._on_imu, best_effort)

    def _on_imu(self, message: Imu) -> None:
        t_ns = header_ns(message)
        if t_ns < self._last_ns:  # the first message, of this flight or of a new one
            self._manoeuvres = Manoeuvres(**self._value)
            self._first_ns, self._last_ns = t_ns, 0  # its rates are not smoothed
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
    return run("rate_reference", RateReference, spin, args, __doc__, PARAMETERS)


if __name__ == "__main__":
    sys.exit(main())
