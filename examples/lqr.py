# SPDX-License-Identifier: Apache-2.0
"""An optimal rate regulator on `model.linearize`, redesigned every second.

``python3 examples/lqr.py --ros-args -p nominal_file:=coefficients.yaml``
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from uav_ident_ros.client import (
    Coefficients,
    CoefficientSource,
    Fallback,
    Refusal,
    answer_rates,
    subscribe,
)

SURFACES = [0, 1, 2]  # de dr da
LARGEST = np.array([0.4, 0.25, 0.25])  # of de dr da from trim, rad
STATE_WEIGHT = np.diag([1.0, 1.0, 1.0]) / 0.1**2  # an error of 0.1 rad/s costs as much ...
INPUT_WEIGHT = np.diag(1.0 / (0.3 * LARGEST) ** 2)  # ... as 0.3 of the travel
STEP = 0.02  # s

Matrix = NDArray[np.float64]


def lqr_gain(a: Matrix, b: Matrix, q: Matrix, r: Matrix) -> Matrix:
    """Return K of ``u = -K x`` that minimises the integral of ``x'Qx + u'Ru``.

    It iterates the Riccati equation of the model sampled every `STEP`, from Q.
    """
    n, m = b.shape
    generator = np.zeros((n + m, n + m))
    generator[:n, :n], generator[:n, n:] = a, b
    term = transition = np.eye(n + m)
    for order in range(1, 20):  # series of the matrix exponential
        term = term @ generator * (STEP / order)
        transition = transition + term
    f, g = transition[:n, :n], transition[:n, n:]
    p = q * STEP
    for _ in range(2000):
        k = np.linalg.solve(r * STEP + g.T @ p @ g, g.T @ p @ f)
        following = q * STEP + f.T @ p @ (f - g @ k)
        if np.abs(following - p).max() < 1e-10 * np.abs(p).max():
            break
        p = following
    return k


class Lqr(Node):
    """Rates in, surfaces out."""

    def __init__(self) -> None:
        super().__init__("lqr")
        nominal = Coefficients.from_file(self.declare_parameter("nominal_file", "").value)
        self.source = CoefficientSource(Fallback.LAST_GOOD, nominal)
        subscribe(self, self.source)
        self.gain, self.designed_ns = np.zeros((3, 3)), -1
        answer_rates(self, self.command)

    def design(self, t_ns: int) -> None:
        """Compute the gain for the newest coefficients, once a second."""
        if self.designed_ns >= 0 and t_ns - self.designed_ns < 10**9:
            return
        try:
            a, b = self.source.model(t_ns).linearize(np.zeros(3), np.zeros(4))
        except Refusal as refusal:  # a set from a file has no flight condition
            self.get_logger().warning(f"waiting: {refusal}", throttle_duration_sec=5.0)
            return
        # the rates alone: flow angles are slower, and the outer loop corrects their effect
        self.gain = lqr_gain(a[:3, :3], b[:3, SURFACES], STATE_WEIGHT, INPUT_WEIGHT)
        self.designed_ns = t_ns

    def command(self, t_ns: int, x: Matrix, reference: Matrix) -> Matrix:
        """Return the surfaces to a sample."""
        self.design(t_ns)
        return np.clip(-self.gain @ (x - reference), -LARGEST, LARGEST)


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Lqr())
