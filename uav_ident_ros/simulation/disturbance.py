# SPDX-License-Identifier: Apache-2.0
"""Gusts: coloured noise as angular acceleration."""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.errors import SimulationError


@dataclass(frozen=True)
class ColouredNoise:
    """Ornstein-Uhlenbeck process (first-order Gauss-Markov)."""

    rms: float = 0.0  # Stationary standard deviation, in the unit of the signal
    correlation_time: float = 0.3  # Time in which the autocorrelation falls to 1 / e, s

    def __post_init__(self) -> None:
        if not (self.rms >= 0.0 and self.correlation_time > 0.0):
            raise SimulationError(
                f"coloured noise with rms {self.rms} and correlation time "
                f"{self.correlation_time} s: rms must be 0 or more, the time positive"
            )

    def sample(
        self, count: int, channels: int, rate: float, rng: np.random.Generator
    ) -> FloatArray:
        """Stationary sample path, shape (count, channels), at `rate` Hz."""
        if self.rms == 0.0:
            return np.zeros((count, channels))
        decay = float(np.exp(-1.0 / (rate * self.correlation_time)))
        white = rng.standard_normal((count, channels))
        white[0] /= np.sqrt(1.0 - decay**2)  # starts in the stationary distribution
        paths = [
            list(accumulate(column, lambda x, w: decay * x + w)) for column in white.T.tolist()
        ]
        return np.asarray(self.rms * np.sqrt(1.0 - decay**2) * np.column_stack(paths))


CALM = ColouredNoise()
"""No disturbance."""
