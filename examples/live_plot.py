# SPDX-License-Identifier: Apache-2.0
"""Plot one coefficient with its band while the node runs, with matplotlib.

``--save FILE`` saves the plot of the first ``--seconds`` in place of a window.
"""

from __future__ import annotations

import argparse
import signal
from typing import Any

import matplotlib
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BAND = 2.0
"""Half width of the band, standard deviations."""


class History(Node):
    """Time, value and standard deviation of one coefficient."""

    def __init__(self, topic: str, name: str) -> None:
        super().__init__("live_plot")
        self.t: list[float] = []
        self.value: list[float] = []
        self.sigma: list[float] = []
        self._name = name
        self.create_subscription(JointState, topic, self._take, LATCHED)

    @property
    def duration(self) -> float:
        """Recorded message time, s."""
        return self.t[-1] - self.t[0] if self.t else 0.0

    def _take(self, message: JointState) -> None:
        index = list(message.name).index(self._name)
        self.t.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
        self.value.append(message.position[index])
        self.sigma.append(message.effort[index])


def draw(axes: Any, history: History, name: str) -> None:
    """Plot the recorded values."""
    t, value, sigma = map(np.array, (history.t, history.value, history.sigma))
    axes.clear()
    if len(t):
        axes.fill_between(t - t[0], value - BAND * sigma, value + BAND * sigma, alpha=0.25)
        axes.plot(t - t[0], value)
    axes.set(xlabel="time [s]", ylabel=f"{name} [SI]")
    axes.grid(alpha=0.3)


def main() -> None:
    """Plot until the window is closed, or save one plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--topic", default="/identifier/coefficients_named")
    parser.add_argument("--name", default="pdot/da", help="coefficient (pdot/da)")
    parser.add_argument("--save", metavar="FILE", help="write a picture instead of showing one")
    parser.add_argument("--seconds", type=float, default=10.0, help="of message time, with --save")
    options = parser.parse_args()
    if options.save:
        matplotlib.use("agg")
    from matplotlib import pyplot

    # An exception by Ctrl-C may be lost in a callback of matplotlib: the loop looks at the signal.
    ended: list[int] = []
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGINT, lambda number, _: ended.append(number))
    history = History(options.topic, options.name)
    figure, axes = pyplot.subplots()
    while not ended and (
        history.duration < options.seconds if options.save else pyplot.fignum_exists(1)
    ):
        rclpy.spin_once(history, timeout_sec=0.05)
        if not options.save:
            draw(axes, history, options.name)
            pyplot.pause(0.2)
    if options.save:
        draw(axes, history, options.name)
        figure.savefig(options.save)
    history.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
