# SPDX-License-Identifier: Apache-2.0
"""Read ~/coefficients_named with rclpy and its message alone, without this package.

The message is a JointState. `name`, `position` (value) and `effort` (standard deviation, 0 of a
fixed coefficient) have the same order. ``verdict/usable`` is 1 if a controller may use the values.
"""

from __future__ import annotations

import argparse
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import JointState

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""QoS of the identifier's outputs: a late subscriber receives the last message."""


def table(message: JointState) -> str:
    """Return the coefficients as text, one in a line, below the verdict."""
    values = dict(zip(message.name, message.position, strict=True))
    usable = values["verdict/usable"] == 1.0
    lines = [f"{message.header.stamp.sec} s: {'usable' if usable else 'not usable'}"]
    for name, value, sigma in zip(message.name, message.position, message.effort, strict=True):
        if not name.startswith(("fit/", "verdict/")):
            lines.append(f"{name:<12}{value:>10.3f} ± {sigma:.3f}")
    return "\n".join(lines)


def main() -> None:
    """Print every message until interrupted, or only the first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--topic", default="/identifier/coefficients_named")
    parser.add_argument("--once", action="store_true", help="the newest message, then end")
    options = parser.parse_args()
    rclpy.init()
    node, first = rclpy.create_node("read_coefficients"), Future()

    def take(message: JointState) -> None:
        print(table(message), flush=True)
        first.set_result(message)

    node.create_subscription(JointState, options.topic, take, LATCHED)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        if options.once:
            rclpy.spin_until_future_complete(node, first)
        else:
            rclpy.spin(node)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
