# SPDX-License-Identifier: Apache-2.0
"""Incremental inversion (INDI): measured acceleration and identified control derivatives alone.

``python3 examples/indi.py --ros-args -p nominal_file:=coefficients.yaml``
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
    History,
    answer_rates,
    subscribe,
)
from uav_ident_ros.control import AxisChoice, Effectiveness, IncrementalLaw, Response

LIMITS = np.array([[-0.4, -0.25, -0.25, 0.0], [0.4, 0.25, 0.25, 0.0]])  # de dr da dth, from trim
DELAY_NS = 20_000_000  # from a sample to the action of its command

Vector = NDArray[np.float64]


class Indi(Node):
    """Rates in, surfaces out."""

    def __init__(self) -> None:
        super().__init__("indi")
        nominal = Coefficients.from_file(self.declare_parameter("nominal_file", "").value)
        self.source = CoefficientSource(Fallback.LAST_GOOD, nominal)
        subscribe(self, self.source)
        self.choice = AxisChoice(self.source, nominal, LIMITS)  # source of each axis's model
        self.law = IncrementalLaw(LIMITS, self.choice.scale)
        self.response = Response()  # measured response to the inputs
        self.measured = Effectiveness()  # corrects sign and size of an axis's effect
        self.sent: History[tuple[Vector, Vector]] = History()  # inputs and reference
        self.last_ns = 0
        answer_rates(self, self.command)

    def command(self, t_ns: int, x: Vector, reference: Vector) -> Vector:
        """Return the surfaces to a sample."""
        dt, self.last_ns = (t_ns - self.last_ns) * 1e-9, t_ns
        acting, led = self.sent.at(t_ns - DELAY_NS) or (np.zeros(4), reference)
        if not 0.0 < dt < 0.1:  # the first sample, or a gap
            self.law.restart(x, reference, acting)
            self.measured.restart()
            self.response.restart()
            dt = 0.0
        effect, found = self.choice.update(t_ns, self.measured), self.response
        inputs, choice = acting[None], self.choice
        if dt and found.update(x, choice.measured_by, inputs, dt, choice.model, led):
            answered, made = found.answered[0], found.made[0]
            self.measured.update(answered, made, dt, found.demanded, effect.share)
        u = self.law.update(dt, effect.values, x, reference, acting)
        self.sent.add(t_ns, (u, reference))
        return u[:3]


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Indi())
