# SPDX-License-Identifier: Apache-2.0
"""The filter that rates and inputs pass alike: low-pass of second order, with its derivative."""

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

DAMPING = 0.8
"""Damping ratio: no overshoot to speak of."""


class Smoother:
    """Low-pass ``w^2 / (s^2 + 2 d w s + w^2)`` of a vector, exact for inputs held between samples.

    Parameters
    ----------
    bandwidth : float
        w, rad/s.
    start : (n,) array
        Value at rest.

    Attributes
    ----------
    value, slope : (n,) arrays
        Filtered signal and its derivative, 1/s.
    """

    def __init__(self, bandwidth: float, start: FloatArray) -> None:
        self._bandwidth = bandwidth
        self.value = np.array(start, dtype=np.float64)
        self.slope = np.zeros_like(self.value)

    def update(self, signal: FloatArray, dt: float) -> None:
        """Move on by `dt` seconds with `signal` held."""
        w = self._bandwidth
        decay, damped = DAMPING * w, w * np.sqrt(1.0 - DAMPING**2)
        away = self.value - signal
        c, s = np.cos(damped * dt), np.sin(damped * dt) / damped
        e = np.exp(-decay * dt)
        self.value = signal + e * (away * (c + decay * s) + self.slope * s)
        self.slope = e * (self.slope * (c - decay * s) - away * w**2 * s)
