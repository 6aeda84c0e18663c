# SPDX-License-Identifier: Apache-2.0
"""The angular acceleration that follows a rate reference: common to all laws."""

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
