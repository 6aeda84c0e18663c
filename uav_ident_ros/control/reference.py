# SPDX-License-Identifier: Apache-2.0
"""The angular acceleration that follows a rate reference, and the filter: common to all laws."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

MAX_INTERVAL = 0.1
"""Interval of the Imu above which a loop starts afresh, s."""


@dataclass(frozen=True)
class Gains:
    """What a law is tuned by."""

    rate: tuple[float, float, float]  # (3,) K: acceleration per rate error of roll, pitch, yaw, 1/s
    bandwidth: float  # Of the law's filter or observer, rad/s
    reference_time: float = 0.1  # Time constant of the reference's derivative, s

    def times(self, factor: float) -> Gains:
        """Return those of a loop that is so much faster."""
        p, q, r = (factor * gain for gain in self.rate)
        return replace(self, rate=(p, q, r), bandwidth=factor * self.bandwidth)


class ReferenceModel:
    """``reference' + K (reference - x)``, the reference differentiated with a lag."""

    def __init__(self, gains: Gains, reference: FloatArray) -> None:
        self._gains = gains
        self._smooth = np.array(reference, dtype=np.float64)

    def wanted(self, dt: float, x: FloatArray, reference: FloatArray) -> FloatArray:
        """Return the angular acceleration, shape (3,), rad/s^2, `dt` seconds after the last."""
        slope = (reference - self._smooth) / self._gains.reference_time
        self._smooth = self._smooth + dt * slope
        return np.asarray(slope + np.array(self._gains.rate) * (reference - x))


# --- the filter that rates and inputs pass alike --------------------------------------------------


DAMPING = 0.8
"""Damping ratio: no overshoot to speak of."""


class Smoother:
    """Low-pass ``w^2 / (s^2 + 2 d w s + w^2)`` of a vector, exact for held inputs."""

    def __init__(
        self,
        bandwidth: float,  # w, rad/s
        start: FloatArray,  # (n,) Value at rest
    ) -> None:
        self._bandwidth = bandwidth
        # Filtered signal and its derivative, 1/s
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
