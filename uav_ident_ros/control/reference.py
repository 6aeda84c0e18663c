# SPDX-License-Identifier: Apache-2.0
"""Reference model and low-pass filter, common to all laws."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

MAX_INTERVAL = 0.1
"""Interval of the Imu above which a loop restarts, s."""


@dataclass(frozen=True)
class Gains:
    """Tuning of a control law."""

    rate: tuple[float, float, float]  # (3,) K: acceleration per rate error of roll, pitch, yaw, 1/s
    bandwidth: float  # Bandwidth of the law's filter or observer, rad/s
    reference_time: float = 0.1  # Time constant of the reference's derivative, s

    def times(self, factor: float) -> Gains:
        """Return the gains of a loop that is faster by a factor."""
        p, q, r = (factor * gain for gain in self.rate)
        return replace(self, rate=(p, q, r), bandwidth=factor * self.bandwidth)


class ReferenceModel:
    """``reference' + K (reference - x)``, the reference differentiated with a lag."""

    def __init__(self, gains: Gains, reference: FloatArray) -> None:
        self._gains = gains
        self._smooth = np.array(reference, dtype=np.float64)

    def wanted(self, dt: float, x: FloatArray, reference: FloatArray) -> FloatArray:
        """Return the wanted angular acceleration after `dt` s, shape (3,), rad/s^2."""
        slope = (reference - self._smooth) / self._gains.reference_time
        self._smooth = self._smooth + dt * slope
        return np.asarray(slope + np.array(self._gains.rate) * (reference - x))


# --- the common filter of rates and inputs --------------------------------------------------------


DAMPING = 0.8
"""Damping ratio: an overshoot of 1.5 %."""


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
        """Advance by `dt` s with `signal` held."""
        w = self._bandwidth
        decay, damped = DAMPING * w, w * np.sqrt(1.0 - DAMPING**2)
        away = self.value - signal
        c, s = np.cos(damped * dt), np.sin(damped * dt) / damped
        e = np.exp(-decay * dt)
        self.value = signal + e * (away * (c + decay * s) + self.slope * s)
        self.slope = e * (self.slope * (c - decay * s) - away * w**2 * s)
