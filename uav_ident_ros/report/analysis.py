# SPDX-License-Identifier: Apache-2.0
"""What the signals of a flight are like: spectra, correlations, whiteness, coverage."""

import math
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, SPECIFIC_FORCES, FloatArray
from uav_ident_ros.offline.tables import AXES
from uav_ident_ros.report.flight import Flight

SIGNALS = (*INPUTS, *AXES, *SPECIFIC_FORCES)
"""Signals of a flight, in the order of `signals`."""

SEGMENT_TIME = 20.0
"""Length of the segments of the spectra, s: it resolves 0.05 Hz."""

HIGHEST_FREQUENCY = 20.0
"""Frequency shown, Hz: no surface and no rigid aircraft answers beyond."""

SAMPLE_RATE = 50.0
"""Signals are resampled at this rate, Hz: 2.5 times the highest frequency."""

BAND = (0.1, 0.9)
"""Shares of the power at the ends of the band that a signal is said to have."""

BANDS_PER_OCTAVE = 3
"""Densities are averaged over thirds of an octave: a comb of sine waves is no curve otherwise."""

LONGEST_LAG = 2.0
"""Lag up to which residuals are compared with themselves, s."""

NORMAL_95 = 1.96
"""Half-width of the interval that holds 95 % of normal deviates, in standard deviations."""


MOST_SAMPLES = 200_000
"""Samples that distributions are drawn of, 17 minutes at 200 Hz; of more, evenly chosen ones."""


def signals(flight: Flight) -> FloatArray:
    """Return inputs, rates and specific forces at gyro samples, shape (N, 9)."""
    every = slice(None, None, -(-len(flight.t) // MOST_SAMPLES))
    return np.concatenate([flight.u[every], flight.rates[every], flight.force[every]], axis=1)


def autocorrelation(residual: FloatArray, lags: int) -> FloatArray:
    """Return the correlation of residuals (N, m) with themselves 1 to `lags` samples later.

    Returns
    -------
    (lags, m) array
        1 is a copy, 0 is white; within 1.96 / sqrt(N) of zero white noise stays in 95 of 100.
    """
    centred = residual - residual.mean(axis=0)
    power = (centred**2).sum(axis=0)
    power[power == 0.0] = np.nan
    return np.array([(centred[k:] * centred[:-k]).sum(axis=0) / power for k in range(1, lags + 1)])


@dataclass(frozen=True)
class Spectra:
    """Power spectral densities by Welch's method."""

    frequency: FloatArray  # (F,) Hz, without zero
    inputs: FloatArray  # (F, 4) Density of de, dr, da, dth, unit^2/Hz
    rates: FloatArray  # (F, 3) Density of p, q, r, (rad/s)^2/Hz

    def band(self, density: FloatArray) -> tuple[float, float]:
        """Return the frequencies, Hz, between which the middle 80 % of the power lies."""
        total = np.cumsum(density)
        if not total[-1] > 0.0:
            return math.nan, math.nan
        low, high = np.searchsorted(total / total[-1], BAND)
        return float(self.frequency[low]), float(self.frequency[high])


def spectra(flight: Flight) -> Spectra | None:
    """Return the spectra of the longest time base; None if it is shorter than two segments."""
    part = max(flight.time_bases, key=lambda p: len(p.t_ns))
    t = flight.clock.seconds(part.era, part.t_ns)
    even = np.arange(t[0], t[-1], 1.0 / SAMPLE_RATE)
    segment = round(SEGMENT_TIME * SAMPLE_RATE)
    if len(even) < 2 * segment:
        return None
    frequency = np.fft.rfftfreq(segment, 1.0 / SAMPLE_RATE)
    shown = (frequency > 0.0) & (frequency <= HIGHEST_FREQUENCY)

    def densities(columns: FloatArray) -> FloatArray:
        resampled = [np.interp(even, flight.t, column) for column in columns.T]
        return np.stack([welch(column, segment) for column in resampled], axis=1)[shown]

    return Spectra(frequency[shown], densities(flight.u), densities(flight.rates))


def welch(values: FloatArray, segment: int) -> FloatArray:
    """Return the one-sided power density of a signal (N,): half overlapping Hann windows."""
    from matplotlib import mlab

    power, _ = mlab.psd(
        values, segment, SAMPLE_RATE, "linear", np.hanning(segment), noverlap=segment // 2
    )
    return np.asarray(power)


def thirds(frequency: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average densities (F, m) over thirds of an octave: middles (B,), Hz, and means (B, m)."""
    octaves = np.log2(frequency / frequency[0])
    band = np.floor(octaves * BANDS_PER_OCTAVE + 0.5).astype(int)
    starts = np.flatnonzero(np.diff(band, prepend=-1))
    count = np.diff(starts, append=len(band))[:, None]
    middle = frequency[0] * 2.0 ** (band[starts] / BANDS_PER_OCTAVE)
    return middle, np.add.reduceat(density, starts, axis=0) / count
