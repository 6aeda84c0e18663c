# SPDX-License-Identifier: Apache-2.0
"""Inversion of the identified model, with a disturbance observer.

``python3 examples/inversion.py --ros-args -p nominal_file:=coefficients.yaml``
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
from uav_ident_ros.control import InversionLaw
from uav_ident_ros.control.allocation import authority
from uav_ident_ros.control.choice import control_derivatives

LIMITS = np.array([[-0.4, -0.25, -0.25, 0.0], [0.4, 0.25, 0.25, 0.0]])  # de dr da dth, from trim
DELAY_NS = 20_000_000  # from a sample to the action of its command

Vector = NDArray[np.float64]


class Inversion(Node):
    """Rates in, surfaces out."""

    def __init__(self) -> None:
        super().__init__("inversion")
        nominal = Coefficients.from_file(self.declare_parameter("nominal_file", "").value)
        self.source = CoefficientSource(Fallback.LAST_GOOD, nominal)
        subscribe(self, self.source)
        self.law = InversionLaw(LIMITS, authority(control_derivatives(nominal)[0], LIMITS))
        self.sent: History[Vector] = History()
        self.last_ns = 0
        answer_rates(self, self.command)

    def command(self, t_ns: int, x: Vector, reference: Vector) -> Vector:
        """Return the surfaces to a sample."""
        model = self.source.model(t_ns)  # the identified, last good or nominal set
        effect = control_derivatives(model)[0]
        dt, self.last_ns = (t_ns - self.last_ns) * 1e-9, t_ns
        if not 0.0 < dt < 0.1:  # the first sample, or a gap
            self.law.restart(model, effect, x, reference)
            dt = 0.0
        acting = self.sent.at(t_ns - DELAY_NS)
        acting = np.zeros(4) if acting is None else acting
        u = self.law.update(dt, model, effect, x, reference, acting)
        self.sent.add(t_ns, u)
        return u[:3]


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Inversion())
