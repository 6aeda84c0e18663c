# SPDX-License-Identifier: Apache-2.0
"""At which frequencies the inputs and the rates moved, and the chart of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.report.drawing import NARROW, Draw, Format, color, legend, tidy, title
from uav_ident_ros.report.flight import AXES, Flight
from uav_ident_ros.report.layout import panels

SEGMENT_TIME = 20.0
"""Length of the segments that are averaged, s: it resolves 0.05 Hz."""

HIGHEST_FREQUENCY = 20.0
"""Frequency shown, Hz: no surface and no rigid aircraft answers beyond."""

SAMPLE_RATE = 50.0
"""Signals are resampled at this rate, Hz: 2.5 times the highest frequency."""

DECADES = 5.0
"""Range of an axis of powers: below is arithmetic, not flight."""

BAND = (0.1, 0.9)
"""Shares of the power at the ends of the band that a signal is said to have."""

BANDS_PER_OCTAVE = 3
"""Densities are averaged over thirds of an octave: a comb of sine waves is no curve otherwise."""

SHADES = ("tick", "ahead", "third", "fourth")
DASHES = ("-", "--", "-.", (0, (3, 1, 1, 1, 1, 1)))

HEIGHT = {"wide": 2.9, "narrow": 4.6}
"""Inches."""


@dataclass(frozen=True)
class Spectra:
    """Power spectral densities by Welch's method.

    Parameters
    ----------
    frequency : (F,) array
        Hz, without zero.
    inputs : (F, 4) array
        Density of de, dr, da, dth, unit^2/Hz.
    rates : (F, 3) array
        Density of p, q, r, (rad/s)^2/Hz.
    """

    frequency: FloatArray
    inputs: FloatArray
    rates: FloatArray

    def band(self, density: FloatArray) -> tuple[float, float]:
        """Return the frequencies, Hz, between which the middle 80 % of the power lies."""
        total = np.cumsum(density)
        if not total[-1] > 0.0:
            return math.nan, math.nan
        low, high = np.searchsorted(total / total[-1], BAND)
        return float(self.frequency[low]), float(self.frequency[high])


def spectra(flight: Flight) -> Spectra | None:
    """Return the spectra of the longest time base; None if it is shorter than two segments."""
    from matplotlib import mlab

    part = max(flight.time_bases, key=lambda p: len(p.t_ns))
    t = flight.clock.seconds(part.era, part.t_ns)
    even = np.arange(t[0], t[-1], 1.0 / SAMPLE_RATE)
    segment = round(SEGMENT_TIME * SAMPLE_RATE)
    if len(even) < 2 * segment:
        return None

    def densities(signals: FloatArray) -> FloatArray:
        columns = [
            mlab.psd(
                np.interp(even, flight.t, column),
                NFFT=segment,
                Fs=SAMPLE_RATE,
                noverlap=segment // 2,
                detrend="linear",
            )[0]
            for column in signals.T
        ]
        return np.stack(columns, axis=1)[shown]

    frequency = np.fft.rfftfreq(segment, 1.0 / SAMPLE_RATE)
    shown = (frequency > 0.0) & (frequency <= HIGHEST_FREQUENCY)
    return Spectra(frequency[shown], densities(flight.u), densities(flight.rates))


def _thirds(frequency: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average densities over bands of equal width on a logarithmic scale.

    Returns
    -------
    frequency : (B,) array
        Geometric middle of the bands that hold something, Hz.
    density : (B, m) array
        Mean densities.
    """
    octaves = np.log2(frequency / frequency[0])
    band = np.floor(octaves * BANDS_PER_OCTAVE + 0.5).astype(int)
    starts = np.flatnonzero(np.diff(band, prepend=-1))
    count = np.diff(starts, append=len(band))[:, None]
    middle = frequency[0] * 2.0 ** (band[starts] / BANDS_PER_OCTAVE)
    return middle, np.add.reduceat(density, starts, axis=0) / count


def spectra_chart(flight: Flight, found: Spectra) -> Draw:
    """Return what draws the spectra of inputs and rates, and the filter's cut-off."""
    cutoff = flight.settings.filter.cutoff / (2.0 * math.pi)

    def draw(figure: Any, form: Format) -> None:
        across = 1 if form is NARROW else 2
        grid = panels(figure, 3 - across, across)
        groups = (("inputs", INPUTS, found.inputs), ("rates", AXES, found.rates))
        for k, (name, labels, density) in enumerate(groups):
            panel = figure.add_subplot(grid[k // across, k % across])
            tidy(panel)
            middle, mean = _thirds(found.frequency, density)
            styles = zip(labels, mean.T, SHADES, DASHES, strict=False)
            for label, column, shade, dashes in styles:
                if column.max() > 0.0:
                    panel.loglog(middle, column, color=color(shade), linestyle=dashes, label=label)
            legend(panel)
            panel.axvline(cutoff, color=color("muted"), linewidth=1.0, linestyle=":")
            top = float(mean.max(initial=0.0)) or 1.0
            panel.set_ylim(top * 10.0**-DECADES, 2.0 * top)
            panel.set_xlim(found.frequency[0], HIGHEST_FREQUENCY)
            panel.set_xticks([0.1, 1.0, 10.0], ["0.1", "1", "10"])
            title(panel, f"{name}, power density")
            if form is not NARROW or k:
                panel.set_xlabel("frequency [Hz]")

    return draw
