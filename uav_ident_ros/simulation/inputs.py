# SPDX-License-Identifier: Apache-2.0
"""Inputs of a simulated flight: excitation in segments, and gusts as coloured noise."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.identification.waveforms import WaveformError, multisines, pulses
from uav_ident_ros.simulation.flight import SimulationError


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
        """Return a stationary sample path, shape (count, channels), at `rate` Hz."""
        if self.rms == 0.0:
            return np.zeros((count, channels))
        decay = float(np.exp(-1.0 / (rate * self.correlation_time)))
        white = rng.standard_normal((count, channels))
        white[0] /= np.sqrt(1.0 - decay**2)  # start in the stationary distribution
        paths = [
            list(accumulate(column, lambda x, w: decay * x + w)) for column in white.T.tolist()
        ]
        return np.asarray(self.rms * np.sqrt(1.0 - decay**2) * np.column_stack(paths))


CALM = ColouredNoise()
"""No disturbance."""


INPUT_KINDS = ("multisine", "3211", "doublet", "quiet")
"""Kinds of excitation by name."""

PAUSE = 2.0
"""Quiet time after the pulses of each input, s. The inputs take turns, cyclically."""


@dataclass(frozen=True)
class Segment:
    """One interval of excitation."""

    kind: str  # ``multisine``, ``3211``, ``doublet`` or ``quiet``
    # start, duration: Start and length, s. Outside of the segment the inputs are zero.
    start: float = 0.0
    duration: float = math.inf
    # Peak by input (``de dr da dth``), rad, throttle 0..1; inputs without a peak stay at zero
    amplitudes: Mapping[str, float] = field(default_factory=dict)
    period: float = 20.0  # Period of the multisines, s
    band: tuple[float, float] = (0.1, 2.0)  # Low, high: band of the multisines, Hz
    unit: float = 0.4  # Length of the shortest pulse of a 3-2-1-1 or doublet, s
    seed: int = 0  # Seed of the multisine phases

    def __post_init__(self) -> None:
        if self.kind not in INPUT_KINDS:
            raise SimulationError(
                f"input kind '{self.kind}' is unknown: use one of {', '.join(INPUT_KINDS)}"
            )
        unknown = [name for name in self.amplitudes if name not in INPUTS]
        if unknown:
            raise SimulationError(
                f"amplitude of unknown input '{unknown[0]}': inputs are {', '.join(INPUTS)}"
            )
        if self.duration < 0.0 or self.unit <= 0.0:
            raise SimulationError(
                f"{self.kind} segment with duration {self.duration} s, unit {self.unit} s: "
                "duration must not be negative, unit must be positive"
            )

    def sample(self, t: FloatArray) -> FloatArray:
        """Return the inputs de, dr, da, dth at times t (s), shape (len(t), 4)."""
        u = np.zeros((len(t), len(INPUTS)))
        # Tolerance for rounding: 0.1 + 0.2 belongs to a segment that starts at 0.3.
        inside = (t >= self.start - 1e-9) & (t < self.start + self.duration - 1e-9)
        peaks = np.array([self.amplitudes.get(name, 0.0) for name in INPUTS])
        active = np.flatnonzero(peaks)
        if self.kind == "quiet" or not len(active) or not inside.any():
            return u
        since, count = t[inside] - self.start, len(active)
        if self.kind == "multisine":
            try:
                shapes = multisines(since, count, self.period, self.band, self.seed)
            except WaveformError as error:
                raise SimulationError(str(error)) from error
        else:
            shapes = pulses(since, count, self.kind, self.unit, PAUSE)
        u[np.ix_(inside, active)] = peaks[active] * shapes
        return u


def sample_inputs(segments: Sequence[Segment], t: FloatArray) -> FloatArray:
    """Return the sum of all segments at times t (s): de, dr, da, dth, shape (len(t), 4)."""
    return sum((segment.sample(t) for segment in segments), np.zeros((len(t), len(INPUTS))))
