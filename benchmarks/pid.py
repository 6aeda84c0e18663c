# SPDX-License-Identifier: Apache-2.0
"""The rate loop of common autopilots, for comparison: PID and feed-forward, axis by axis.

    u_i = F_i reference_i + P_i (reference_i - x_i) + I_i integral - D_i xdot_f,i

Each axis has one surface. The integrator is held while its surface is at a limit.
"""

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.control.laws import MAX_INTERVAL, Smoother
from uav_ident_ros.identification.structure import INPUTS, FloatArray

SURFACES = tuple(INPUTS.index(name) for name in ("da", "de", "dr"))
"""Indices of the inputs of roll, pitch and yaw."""


@dataclass(frozen=True)
class PidGains:
    """Gains of roll, pitch, yaw, in rad of the surface: (3,) arrays."""

    # forward, proportional, integral, derivative: (3,) F (s), P (s), I (1), D (s^2)
    forward: FloatArray
    proportional: FloatArray
    integral: FloatArray
    derivative: FloatArray
    bandwidth: float = 30.0  # Of the derivative's filter, rad/s


class PidController:
    """PID rate control; `limits` as in `IncrementalLaw`."""

    def __init__(self, limits: FloatArray, gains: PidGains) -> None:
        self._low, self._high = limits[:, SURFACES]
        self.gains, self._last_ns = gains, 0

    def update(self, t_ns: int, x: FloatArray, reference: FloatArray) -> FloatArray:
        """Return de, dr, da, dth, deviations from trim; parameters as in `RateController`."""
        dt, self._last_ns = (t_ns - self._last_ns) * 1e-9, t_ns
        if not 0.0 < dt < MAX_INTERVAL:
            self._rates, self._integral = Smoother(self.gains.bandwidth, x), np.zeros(3)
            dt = 0.0
        g, error = self.gains, reference - x
        self._rates.update(x, dt)
        wanted = g.forward * reference + g.proportional * error - g.derivative * self._rates.slope
        grown = self._integral + dt * g.integral * error
        held = np.clip(wanted + grown, self._low, self._high) != wanted + grown
        outward = np.sign(wanted + grown) == np.sign(dt * g.integral * error)
        self._integral = np.where(held & outward, self._integral, grown)
        u = np.zeros(4)
        u[list(SURFACES)] = np.clip(wanted + self._integral, self._low, self._high)
        return u
