# SPDX-License-Identifier: Apache-2.0
"""Programmed test inputs: what is added to de, dr, da, dth on purpose, over one run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.settings import ExcitationSettings
from uav_ident_ros.identification.structure import INPUTS, BoolArray, FloatArray
from uav_ident_ros.identification.waveforms import PULSES, multisines, pulses, turn_time

LOWEST_CYCLES = 2.0
"""Cycles of the lowest frequency in the period of the multisines (Morelli 2003)."""

DOUBLET_PEAK = 0.371
"""Frequency, relative to one over the length of its pulses, at which a doublet's spectrum is
highest: the maximum of sin(pi x)^2 / x. The pulses are as long as puts it in mid-band."""

PAUSE_UNITS = 2.0 * sum(length for length, _ in PULSES["doublet"])
"""Quiet time after each input's pulses, in units: twice a doublet, for the response to fade."""


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
        self._shapes(np.zeros(1))  # designed here, so that nothing is slow in flight

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
        """Time after which every input has had its share, s: a period, or a turn of all."""
        count = int(self.excited.sum())
        if self.settings.form == "multisine":
            return LOWEST_CYCLES / self.settings.band[0]
        return count * turn_time(self._pulses, self._unit, self._pause)

    @property
    def duration(self) -> float:
        """Length of the run, s: a probe goes round once, pulses an whole number of times."""
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
    def _pulses(self) -> str:
        return "doublet" if self.settings.form == "probe" else self.settings.form

    @property
    def _unit(self) -> float:
        low, high = self.settings.band
        return DOUBLET_PEAK / math.sqrt(low * high)

    @property
    def _pause(self) -> float:
        return PAUSE_UNITS * self._unit

    def _shapes(self, t: FloatArray) -> FloatArray:
        """Shapes, peak one, of the excited inputs, (len(t), count)."""
        count = int(self.excited.sum())
        if self.settings.form == "multisine":
            low, high = self.settings.band
            return multisines(t, count, self.period, (low, high))
        return pulses(t, count, self._pulses, self._unit, self._pause)
