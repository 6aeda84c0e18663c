# SPDX-License-Identifier: Apache-2.0
"""Read ~/coefficients_named with rclpy and its message alone: nothing of this package is needed.

The message is a JointState: `name`, `position` (value) and `effort` (standard deviation, 0 where a
coefficient is fixed) run side by side. ``verdict/usable`` says whether a controller may act on it.
"""

from __future__ import annotations

import argparse

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""As the identifier publishes: the last message arrives at once."""


def table(message: JointState) -> str:
    """Return the coefficients as text, one a line, the verdict on top."""
    entries = dict(
        zip(message.name, zip(message.position, message.effort, strict=True), strict=True)
    )
    usable = entries["verdict/usable"][0] == 1.0
    lines = [f"{message.header.stamp.sec} s: {'usable' if usable else 'not usable'}"]
    for name, (value, sigma) in entries.items():
        if name.startswith(("fit/", "verdict/")):
            continue
        lines.append(f"{name:<12}{value:>10.3f} ± {sigma:.3f}")
    return "\n".join(lines)


class Reader(Node):
    """Print every message, or the first alone."""

    def __init__(self, topic: str, once: bool) -> None:
        super().__init__("read_coefficients")
        self.done = False
        self._once = once
        self.create_subscription(JointState, topic, self._take, LATCHED)

    def _take(self, message: JointState) -> None:
        print(table(message), flush=True)
        self.done = self._once


def main() -> None:
    """Read until interrupted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--topic", default="/identifier/coefficients_named")
    parser.add_argument("--once", action="store_true", help="the newest message, then end")
    options = parser.parse_args()
    rclpy.init()
    reader = Reader(options.topic, options.once)
    try:
        while not reader.done:
            rclpy.spin_once(reader, timeout_sec=1.0)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        reader.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
