# SPDX-License-Identifier: Apache-2.0
"""Test inputs of peak one: orthogonal multisines, 3-2-1-1, doublets.

Multisines after E. A. Morelli, "Flight test experiment design for system identification
from limited input amplitude", 2003: every input has its own harmonics of a common period. The
inputs are thus orthogonal over a period. Optimised phases keep the peak low.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from uav_ident_ros.identification.scales import ROUNDING
from uav_ident_ros.identification.settings import ExcitationSettings
from uav_ident_ros.identification.structure import INPUTS, BoolArray, FloatArray

PEAK_SAMPLES_PER_CYCLE = 32
"""Samples per cycle of the highest harmonic when the peak of a multisine is measured."""

PEAK_ERROR = 0.5 * (math.pi / PEAK_SAMPLES_PER_CYCLE) ** 2
"""Relative error of a peak that lies between two samples, 0.5 %: a smaller fall is none."""

PULSES: dict[str, tuple[tuple[float, float], ...]] = {
    "3211": ((3.0, 1.0), (2.0, -1.0), (1.0, 1.0), (1.0, -1.0)),
    "doublet": ((1.0, 1.0), (1.0, -1.0)),
}
"""Length, in units, and sign of each pulse of a shape."""


class WaveformError(ValueError):
    """A shape is not possible; the message names it and the reason."""


def _period(harmonics: Sequence[int], phases: FloatArray) -> FloatArray:
    """Return one period of the sum of unit cosines, by inverse FFT."""
    count = 1 << math.ceil(math.log2(PEAK_SAMPLES_PER_CYCLE * max(harmonics)))
    spectrum = np.zeros(count // 2 + 1, dtype=np.complex128)
    spectrum[list(harmonics)] = 0.5 * count * np.exp(1j * phases)
    return np.fft.irfft(spectrum, count)


def _low_peak_phases(harmonics: Sequence[int], rng: np.random.Generator) -> FloatArray:
    """Return phases with a low peak, from random ones.

    The L2p norms of the signal approach its peak as p grows. Gauss-Newton steps, whole or half,
    lower each norm while the peak falls too; then p doubles (Guillaume et al. 1991). With as many
    samples as p the norm is the peak.
    """
    phases = rng.uniform(-np.pi, np.pi, len(harmonics))
    signal = _period(harmonics, phases)
    angles = np.multiply.outer(2.0 * np.pi / len(signal) * np.arange(len(signal)), harmonics)
    p = 2
    while p <= len(signal):
        peak = np.abs(signal).max()
        weight = (np.abs(signal) / peak) ** (p - 1)
        slope = -p * weight[:, None] * np.sin(angles + phases)
        normal = slope.T @ slope
        normal += ROUNDING * np.trace(normal) * np.eye(len(phases))  # a time shift changes no norm
        step = np.linalg.solve(normal, slope.T @ (weight * signal))
        for tried in (phases - step, phases - 0.5 * step):
            moved = _period(harmonics, tried)
            if np.abs(moved).max() < (1.0 - PEAK_ERROR) * peak:
                phases, signal = tried, moved
                break
        else:
            p *= 2
    return phases


@lru_cache(maxsize=64)
def _design(harmonics: tuple[int, ...], seed: int) -> tuple[FloatArray, float]:
    """Return the phases, rad, of unit cosines with a sum that starts at zero, and its peak."""
    phases = _low_peak_phases(harmonics, np.random.default_rng(seed))
    signal = _period(harmonics, phases)
    # A time shift of all harmonics keeps the shape: begin at an upward zero crossing.
    crossing = int(np.flatnonzero((signal <= 0.0) & (np.roll(signal, -1) > 0.0))[0])
    fraction = signal[crossing] / (signal[crossing] - np.roll(signal, -1)[crossing])
    shift = 2.0 * np.pi * (crossing + fraction) / len(signal)
    phases = np.mod(phases + shift * np.asarray(harmonics), 2.0 * np.pi)
    return phases, float(np.abs(signal).max())


def multisines(
    t: FloatArray,  # (k,) Times from the start, s
    count: int,  # Number of inputs
    period: float,  # Common period of all harmonics, s
    band: tuple[float, float],  # Lowest and highest frequency, Hz; its harmonics go in turn
    seed: int = 0,  # Of the initial phases of the optimisation
) -> FloatArray:
    """Return orthogonal multisines of `count` inputs, of a low peak factor, (k, count).

    Raises
    ------
    WaveformError
        If there are fewer harmonics than inputs.
    """
    first = max(1, math.ceil(band[0] * period - 1e-9))
    last = math.floor(band[1] * period + 1e-9)
    if last - first + 1 < count:
        raise WaveformError(
            f"multisine band {band[0]:g} ... {band[1]:g} Hz over a period of {period:g} s has "
            f"{max(0, last - first + 1)} harmonics: at least {count}, one per input, are needed; "
            "widen the band or lengthen the period"
        )
    signals = []
    for i in range(count):
        harmonics = tuple(range(first + i, last + 1, count))
        phases, peak = _design(harmonics, seed + i)
        omega = 2.0 * np.pi / period * np.asarray(harmonics)
        signals.append(np.cos(np.multiply.outer(t, omega) + phases).sum(axis=-1) / peak)
    return np.stack(signals, axis=1)


def turn_time(shape: str, unit: float, pause: float) -> float:
    """Return the duration of one input's pulses and the pause after them, s."""
    return unit * sum(length for length, _ in PULSES[shape]) + pause


def pulses(
    t: FloatArray,  # (k,) Times from the start, s
    count: int,  # Number of inputs
    shape: str,  # ``3211`` or ``doublet``
    unit: float,  # Length of the shortest pulse, s
    pause: float,  # Quiet time after each input's turn, s
) -> FloatArray:
    """Return pulses of `count` inputs in turn, repeated without end, shape (len(t), count)."""
    turn = turn_time(shape, unit, pause)
    # The tolerance covers rounding: a pulse begins at the sample at its edge.
    local = np.mod(t + 1e-9, count * turn)
    u = np.zeros((len(t), count))
    for i in range(count):
        edge = i * turn
        for length, sign in PULSES[shape]:
            until = edge + length * unit
            u[(local >= edge) & (local < until), i] = sign
            edge = until
    return u


# --- over one run ---------------------------------------------------------------------------------


LOWEST_CYCLES = 2.0
"""Cycles of the lowest frequency in the period of the multisines (Morelli 2003)."""

DOUBLET_PEAK = 0.371
"""Frequency of the maximum of a doublet's spectrum, times the length of its pulses: the maximum of
sin(pi x)^2 / x. The length of the pulses places it in mid-band."""

PAUSE_UNITS = 2.0 * sum(length for length, _ in PULSES["doublet"])
"""Quiet time after each input's pulses, in units: twice a doublet, in which the response decays."""


@dataclass(frozen=True)
class ProgrammedInput:
    """The signals of one run.

    Raises
    ------
    WaveformError
        If the band holds fewer harmonics than there are inputs.
    """

    settings: ExcitationSettings  # Form, amplitudes, band, duration and fade

    def __post_init__(self) -> None:
        self._shapes(np.zeros(1))  # the slow design is cached here, before the run

    @property
    def excited(self) -> BoolArray:
        """Inputs that are excited, shape (4,)."""
        return np.array(self.settings.amplitude) > 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs that are excited."""
        return tuple(name for name, on in zip(INPUTS, self.excited, strict=True) if on)

    @property
    def period(self) -> float:
        """Common period of the multisines, or duration of one turn of all inputs, s."""
        if self.settings.form == "multisine":
            return LOWEST_CYCLES / self.settings.band[0]
        return int(self.excited.sum()) * turn_time(*self._turn)

    @property
    def duration(self) -> float:
        """Length of the run, s: one period of a probe, a whole number of periods of pulses."""
        if self.settings.form == "probe":
            return self.period
        if self.settings.form == "multisine":
            return self.settings.duration
        return self.period * max(1.0, math.floor(self.settings.duration / self.period + 1e-9))

    def sample(self, t: float) -> FloatArray:
        """Evaluate at `t` s from the start: de, dr, da, dth, shape (4,), in their units."""
        if not 0.0 <= t < self.duration:
            return np.zeros(len(INPUTS))
        values = np.zeros(len(INPUTS))
        values[self.excited] = self._shapes(np.array([t]))[0]
        if self.settings.form == "multisine" and self.settings.fade_time > 0.0:
            values *= min(1.0, min(t, self.duration - t) / self.settings.fade_time)
        return np.asarray(values * np.array(self.settings.amplitude))

    @property
    def _turn(self) -> tuple[str, float, float]:
        """Shape, shortest pulse and pause, s, of inputs in turn."""
        form, (low, high) = self.settings.form, self.settings.band
        unit = DOUBLET_PEAK / math.sqrt(low * high)
        return "doublet" if form == "probe" else form, unit, PAUSE_UNITS * unit

    def _shapes(self, t: FloatArray) -> FloatArray:
        """Return the signals of the excited inputs, of peak one, (len(t), count)."""
        count = int(self.excited.sum())
        if self.settings.form == "multisine":
            low, high = self.settings.band
            return multisines(t, count, self.period, (low, high))
        return pulses(t, count, *self._turn)
