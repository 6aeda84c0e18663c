# SPDX-License-Identifier: Apache-2.0
"""Excitation of the inputs: orthogonal multisines, 3-2-1-1, doublets, quiet.

Multisines after E. A. Morelli, "Flight test experiment design for system identification
from limited input amplitude", 2003: every input has its own harmonics of one period, so that
over a period the inputs are orthogonal, with phases that keep the peak low.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.errors import SimulationError

PEAK_SAMPLES_PER_CYCLE = 32
"""Samples per cycle of the highest harmonic when the peak of a multisine is measured."""

CLIPPING_ITERATIONS = 300
"""Enough for the peak factor to settle (it changes by less than 1 % from 150 to 300)."""

CLIPPING_RESTARTS = 6
"""Random starts of the peak optimisation, of which the best is kept."""

CLIPPING_START, CLIPPING_END = 0.75, 0.98
"""Clip level relative to the present peak, from the first iteration to the last."""

PULSES_3211 = ((3.0, 1.0), (2.0, -1.0), (1.0, 1.0), (1.0, -1.0))
PULSES_DOUBLET = ((1.0, 1.0), (1.0, -1.0))


@dataclass(frozen=True)
class Multisine:
    """Sum of harmonics of one period with optimised phases, peak amplitude one.

    Parameters
    ----------
    period : float
        Common period of all harmonics, s.
    harmonics : tuple of int
        Multiples of 1 / period that are present, with equal power.
    phases : (k,) array
        Their phases, rad.
    peak : float
        Peak of the sum of unit cosines, by which `sample` divides.
    """

    period: float
    harmonics: tuple[int, ...]
    phases: FloatArray
    peak: float

    def sample(self, t: FloatArray) -> FloatArray:
        """Evaluate at times t, s; peak about one, zero at t = 0."""
        omega = 2.0 * np.pi / self.period * np.asarray(self.harmonics)
        waves = np.cos(np.multiply.outer(t, omega) + self.phases)
        return np.asarray(waves.sum(axis=-1) / self.peak)

    @property
    def relative_peak_factor(self) -> float:
        """Peak-to-peak over 2 sqrt(2) rms: one for a single sine."""
        signal = _period(self.harmonics, self.phases)
        return float(np.ptp(signal) / (2.0 * np.sqrt(2.0) * np.sqrt(np.mean(signal**2))))


def _period(harmonics: Sequence[int], phases: FloatArray) -> FloatArray:
    """One period of the sum of unit cosines, by inverse FFT."""
    count = 1 << math.ceil(math.log2(PEAK_SAMPLES_PER_CYCLE * max(harmonics)))
    spectrum = np.zeros(count // 2 + 1, dtype=np.complex128)
    spectrum[list(harmonics)] = 0.5 * count * np.exp(1j * phases)
    return np.fft.irfft(spectrum, count)


def _low_peak_phases(harmonics: Sequence[int], rng: np.random.Generator) -> FloatArray:
    """Phases with a low peak: clip in time, keep the phases, repeat (Van der Ouderaa 1988)."""
    index = list(harmonics)
    best, best_spread = np.zeros(len(index)), np.inf
    for _ in range(CLIPPING_RESTARTS):
        phases = rng.uniform(-np.pi, np.pi, len(index))
        for clip in np.linspace(CLIPPING_START, CLIPPING_END, CLIPPING_ITERATIONS):
            signal = _period(index, phases)
            spread = float(np.ptp(signal))
            if spread < best_spread:
                best, best_spread = phases, spread
            limit = clip * float(np.abs(signal).max())
            phases = np.angle(np.fft.rfft(np.clip(signal, -limit, limit))[index])
    return best


@lru_cache(maxsize=64)
def multisine(period: float, harmonics: tuple[int, ...], seed: int = 0) -> Multisine:
    """Design a multisine with a low relative peak factor that starts at zero.

    Parameters
    ----------
    period : float
        Common period, s.
    harmonics : tuple of int
        Multiples of 1 / period, each at least 1.
    seed : int
        Seed of the phases from which the optimisation starts.
    """
    if period <= 0.0 or not harmonics or min(harmonics) < 1:
        raise SimulationError(
            f"multisine with period {period} s and harmonics {list(harmonics)}: the period must "
            "be positive and the harmonics whole numbers from 1"
        )
    phases = _low_peak_phases(harmonics, np.random.default_rng(seed))
    signal = _period(harmonics, phases)
    # Shifting all harmonics by one time leaves the shape: start at an upward zero crossing.
    crossing = int(np.flatnonzero((signal <= 0.0) & (np.roll(signal, -1) > 0.0))[0])
    fraction = signal[crossing] / (signal[crossing] - np.roll(signal, -1)[crossing])
    shift = 2.0 * np.pi * (crossing + fraction) / len(signal)
    phases = np.mod(phases + shift * np.asarray(harmonics), 2.0 * np.pi)
    return Multisine(period, tuple(harmonics), phases, float(np.abs(signal).max()))


def disjoint_harmonics(
    count: int, period: float, band: tuple[float, float]
) -> tuple[tuple[int, ...], ...]:
    """Deal the harmonics of a band out to `count` inputs in turn.

    Parameters
    ----------
    count : int
        Number of inputs.
    period : float
        Common period, s.
    band : (low, high)
        Band, Hz.
    """
    first = max(1, math.ceil(band[0] * period - 1e-9))
    last = math.floor(band[1] * period + 1e-9)
    if last - first + 1 < count:
        raise SimulationError(
            f"multisine band {band[0]:g} ... {band[1]:g} Hz over a period of {period:g} s has "
            f"{max(0, last - first + 1)} harmonics: at least {count}, one per input, are needed; "
            "widen the band or lengthen the period"
        )
    return tuple(tuple(range(first + i, last + 1, count)) for i in range(count))


@dataclass(frozen=True)
class Segment:
    """One stretch of excitation.

    Parameters
    ----------
    kind : str
        ``multisine``, ``3211``, ``doublet`` or ``quiet``.
    start, duration : float
        When it begins and how long it lasts, s. Outside of it the inputs are zero.
    amplitudes : mapping
        Peak per input (``de dr da dth``), rad, throttle 0..1; inputs left out stay at zero.
    period : float
        Period of the multisines, s.
    band : (low, high)
        Band of the multisines, Hz.
    unit : float
        Length of the shortest pulse of a 3-2-1-1 or doublet, s.
    pause : float
        Quiet time after each input's pulses, s; then the next input has its turn, and after
        the last one the first again.
    seed : int
        Seed of the multisine phases.
    """

    kind: str
    start: float = 0.0
    duration: float = math.inf
    amplitudes: Mapping[str, float] = field(default_factory=dict)
    period: float = 20.0
    band: tuple[float, float] = (0.1, 2.0)
    unit: float = 0.4
    pause: float = 2.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in _SHAPES:
            raise SimulationError(
                f"input kind '{self.kind}' is unknown: use one of {', '.join(_SHAPES)}"
            )
        unknown = [name for name in self.amplitudes if name not in INPUTS]
        if unknown:
            raise SimulationError(
                f"amplitude of unknown input '{unknown[0]}': inputs are {', '.join(INPUTS)}"
            )
        if self.duration < 0.0 or self.unit <= 0.0 or self.pause < 0.0:
            raise SimulationError(
                f"{self.kind} segment with duration {self.duration} s, unit {self.unit} s, pause "
                f"{self.pause} s: duration and pause must not be negative, unit must be positive"
            )

    def sample(self, t: FloatArray) -> FloatArray:
        """Return the inputs de, dr, da, dth at times t (s), shape (len(t), 4)."""
        u = np.zeros((len(t), len(INPUTS)))
        # A hair of tolerance, so that 0.1 + 0.2 is not left out of a segment from 0.3.
        inside = (t >= self.start - 1e-9) & (t < self.start + self.duration - 1e-9)
        active = [(INPUTS.index(name), a) for name, a in self.amplitudes.items() if a]
        if active and np.any(inside):
            active.sort()
            shapes = _SHAPES[self.kind](self, t[inside], len(active))
            for (column, amplitude), shape in zip(active, shapes.T, strict=True):
                u[inside, column] = amplitude * shape
        return u


def _sample_multisine(segment: Segment, t: FloatArray, count: int) -> FloatArray:
    harmonics = disjoint_harmonics(count, segment.period, segment.band)
    return np.stack(
        [
            multisine(segment.period, own, segment.seed + i).sample(t - segment.start)
            for i, own in enumerate(harmonics)
        ],
        axis=1,
    )


def _sample_pulses(
    segment: Segment, t: FloatArray, count: int, pulses: Sequence[tuple[float, float]]
) -> FloatArray:
    turn = segment.unit * sum(length for length, _ in pulses) + segment.pause
    local = np.mod(t - segment.start + 1e-9, count * turn)
    u = np.zeros((len(t), count))
    for i in range(count):
        edge = i * turn
        for length, sign in pulses:
            until = edge + length * segment.unit
            u[(local >= edge) & (local < until), i] = sign
            edge = until
    return u


def _sample_3211(segment: Segment, t: FloatArray, count: int) -> FloatArray:
    return _sample_pulses(segment, t, count, PULSES_3211)


def _sample_doublet(segment: Segment, t: FloatArray, count: int) -> FloatArray:
    return _sample_pulses(segment, t, count, PULSES_DOUBLET)


def _sample_quiet(segment: Segment, t: FloatArray, count: int) -> FloatArray:
    return np.zeros((len(t), count))


_SHAPES: dict[str, Callable[[Segment, FloatArray, int], FloatArray]] = {
    "multisine": _sample_multisine,
    "3211": _sample_3211,
    "doublet": _sample_doublet,
    "quiet": _sample_quiet,
}

INPUT_KINDS = tuple(_SHAPES)
"""Kinds of excitation by name."""


def sample_inputs(segments: Sequence[Segment], t: FloatArray) -> FloatArray:
    """Sum of all segments at times t (s): inputs de, dr, da, dth, shape (len(t), 4)."""
    t = np.asarray(t, dtype=np.float64)
    u = np.zeros((len(t), len(INPUTS)))
    for segment in segments:
        u += segment.sample(t)
    return u


def excited_intervals(
    segments: Sequence[Segment], duration: float
) -> tuple[tuple[float, float], ...]:
    """(start, end) of every segment that excites something, s."""
    return tuple(
        (s.start, min(duration, s.start + s.duration))
        for s in segments
        if s.kind != "quiet" and any(s.amplitudes.values())
    )
