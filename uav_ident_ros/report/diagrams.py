# SPDX-License-Identifier: Apache-2.0
"""The charts not over time: whiteness, spectra, coverage, modes, delay."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from bokeh.models import BoxAnnotation, FixedTicker, LinearColorMapper, Span
from bokeh.palettes import Blues256

from uav_ident_ros.identification.linearisation import Mode
from uav_ident_ros.identification.prediction import LAST_PART
from uav_ident_ros.identification.structure import INPUTS, RATES, SPECIFIC_FORCES, FloatArray
from uav_ident_ros.report.flight import Predictions, ReplayedFlight
from uav_ident_ros.report.style import COLORS, DASHES, SERIES
from uav_ident_ros.report.timeline import Chart, columns, hover, plain_figure, value_range

SEGMENT_TIME = 20.0
"""Length of the segments of the spectra, s: it resolves 0.05 Hz."""

HIGHEST_FREQUENCY = 20.0
"""Highest frequency shown, Hz: beyond the bandwidth of surfaces and rigid aircraft."""

SAMPLE_RATE = 50.0
"""Rate of the resampled signals, Hz: 2.5 times the highest frequency."""

BANDS_PER_OCTAVE = 3
"""Bands per octave over which densities are averaged: the lines of a multisine become a curve."""

LONGEST_LAG = 2.0
"""Longest lag of the autocorrelation, s."""

NORMAL_95 = 1.96
"""Half-width of the interval that holds 95 % of normal deviates, in standard deviations."""


MOST_SAMPLES = 200_000
"""Most samples of a distribution, 17 minutes at 200 Hz; more are thinned evenly."""


def signals(flight: ReplayedFlight) -> dict[str, FloatArray]:
    """Return inputs, rates and specific forces at gyro samples, by name, (N,) each."""
    step = -(-len(flight.t) // MOST_SAMPLES)
    values = (*flight.u[::step].T, *flight.rates[::step].T, *flight.force[::step].T)
    return dict(zip((*INPUTS, *RATES, *SPECIFIC_FORCES), values, strict=True))


def autocorrelation(residual: FloatArray, lags: int) -> FloatArray:
    """Return the autocorrelation of residuals (N, m) at lags of 1 to `lags` samples, (lags, m).

    It is 0 for white noise, of which 95 % is within 1.96 / sqrt(N) of zero.
    """
    centred = residual - residual.mean(axis=0)
    power = (centred**2).sum(axis=0)
    power[power == 0.0] = np.nan
    return np.array([(centred[k:] * centred[:-k]).sum(axis=0) / power for k in range(1, lags + 1)])


def welch(values: FloatArray, segment: int) -> FloatArray:
    """Return the one-sided power density of a signal (N,) with half overlapping Hann windows."""
    from matplotlib import mlab

    power, _ = mlab.psd(
        values, segment, SAMPLE_RATE, "linear", np.hanning(segment), noverlap=segment // 2
    )
    return np.asarray(power)


def thirds(frequency: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the averages of densities (F, m) over bands: centres (B,), Hz, and means (B, m)."""
    octaves = np.log2(frequency / frequency[0])
    band = np.floor(octaves * BANDS_PER_OCTAVE + 0.5).astype(int)
    starts = np.flatnonzero(np.diff(band, prepend=-1))
    count = np.diff(starts, append=len(band))[:, None]
    middle = frequency[0] * 2.0 ** (band[starts] / BANDS_PER_OCTAVE)
    return middle, np.add.reduceat(density, starts, axis=0) / count


# --- charts ---------------------------------------------------------------------------------------


DECADES = 5.0
"""Range of an axis of powers: values below are rounding errors."""

PAIRS = (("da", "dr"), ("de", "dth"), ("p", "r"), ("q", "p"))
"""Signals on the x and y axes of the charts of coverage."""

CELLS = 36
"""Cells of such a chart along each axis."""

SHARE = (0.1, 99.9)
"""Percentiles of a signal that its axis spans."""

LARGEST_RISE = 200.0
"""Largest prediction error shown, percent above the least: the minimum is of interest."""

SMALLEST_RISE = 0.01
"""Rise, percent, below which all delays predict alike: the inputs hardly moved."""


def _lines(chart: Any, x: FloatArray, lines: dict[str, FloatArray], unit: str) -> None:
    """Draw several lines, with a legend and tooltips."""
    source = columns({"x": x, **lines})
    for k, name in enumerate(lines):
        style = {"color": COLORS[SERIES[k]], "line_dash": DASHES[k], "line_width": 1.5}
        drawn = chart.line("x", name, source=source, legend_label=name, **style)
        hover(chart, drawn, (unit, "@x{0.000}"), (name, f"@{{{name}}}{{0.000e+0}}"), mode="vline")


def whiteness_chart(flight: ReplayedFlight, tick: Predictions) -> Chart | None:
    """Return the autocorrelation of the residuals one tick ahead; None if there are too few."""
    residual = tick.residual[tick.t >= flight.span[1] * (1.0 - LAST_PART)]
    lags = round(LONGEST_LAG / tick.horizon)
    if len(residual) < 2 * lags:
        return None
    found = np.nan_to_num(autocorrelation(residual, lags))
    span = value_range(found, np.array([0.0, 0.2]))
    chart = plain_figure(220, "lag [s]", "autocorrelation", y_range=span)
    lag = tick.horizon * np.arange(1, lags + 1)
    _lines(chart, lag, dict(zip(RATES, found.T, strict=True)), "lag [s]")
    bound = NORMAL_95 / math.sqrt(len(residual))
    chart.add_layout(
        BoxAnnotation(bottom=-bound, top=bound, fill_color=COLORS["measured"], fill_alpha=0.2)
    )
    return Chart("whiteness", "Autocorrelation of the residuals", chart)


def spectrum_charts(flight: ReplayedFlight) -> Iterator[Chart]:
    """Yield the power densities of inputs and rates by Welch's method; none if it is too short."""
    even = np.arange(flight.t[0], flight.t[-1], 1.0 / SAMPLE_RATE)
    segment = round(SEGMENT_TIME * SAMPLE_RATE)
    if len(even) < 2 * segment:
        return
    frequency = np.fft.rfftfreq(segment, 1.0 / SAMPLE_RATE)
    within = (frequency > 0.0) & (frequency <= HIGHEST_FREQUENCY)
    cutoff = flight.settings.filter.cutoff / (2.0 * math.pi)
    groups = (("inputs", INPUTS, flight.u), ("rates", RATES, flight.rates))
    for name, labels, values in groups:
        resampled = [np.interp(even, flight.t, column) for column in values.T]
        density = np.stack([welch(column, segment) for column in resampled], axis=1)
        middle, mean = thirds(frequency[within], density[within])
        top = float(mean.max(initial=0.0)) or 1.0
        logarithmic = {"x_axis_type": "log", "y_axis_type": "log"}
        spans = {
            "x_range": (float(frequency[within][0]), HIGHEST_FREQUENCY),
            "y_range": (top * 10.0**-DECADES, 2.0 * top),
        }
        chart = plain_figure(230, "frequency [Hz]", "power density", **logarithmic, **spans)
        chart.xaxis.ticker = FixedTicker(ticks=[0.1, 1.0, 10.0])
        shown = {k: v for k, v in zip(labels, mean.T, strict=True) if v.max() > 0.0}
        _lines(chart, middle, shown, "f [Hz]")
        chart.add_layout(
            Span(dimension="height", location=cutoff, line_dash="dotted", line_width=1)
        )
        yield Chart(f"spectra-{name}", f"Spectra of the {name}", chart)


def coverage_charts(flight: ReplayedFlight) -> Iterator[Chart]:
    """Yield the two-dimensional histograms of pairs of signals."""
    values = signals(flight)
    for x, y in PAIRS:
        spans = [_span(values[x]), _span(values[y])]
        count, _, _ = np.histogram2d(values[x], values[y], bins=CELLS, range=spans)
        depth = np.log1p(count.T) / np.log1p(max(float(count.max()), 1.0))
        depth[count.T == 0] = np.nan
        chart = plain_figure(200, x, y, x_range=spans[0], y_range=spans[1])
        chart.xaxis.ticker.desired_num_ticks = 4
        chart.image(
            [depth.astype(np.float32)],
            x=spans[0][0],
            y=spans[1][0],
            dw=spans[0][1] - spans[0][0],
            dh=spans[1][1] - spans[1][0],
            color_mapper=LinearColorMapper(Blues256[200::-1], nan_color="#ffffff00"),
        )
        yield Chart(f"coverage-{x}-{y}", f"{y} over {x}", chart, small=True)


def mode_chart(found: Sequence[Mode]) -> Chart:
    """Return the modes in the upper half of the complex plane, with ellipses of one sigma."""
    real = np.array([mode.eigenvalue.real for mode in found])
    imaginary = np.array([mode.eigenvalue.imag for mode in found])
    sigma = np.array([mode.eigenvalue_sigma for mode in found])
    room = 2.0 * np.where(np.isfinite(sigma), sigma, 0.0)
    chart = plain_figure(
        260,
        "real part [1/s]",
        "imaginary part [rad/s]",
        x_range=value_range(real - room[:, 0], real + room[:, 0], np.zeros(1)),
        y_range=value_range(imaginary + room[:, 1], np.zeros(1)),
    )
    source = columns(
        {"re": real, "im": imaginary, "width": 2.0 * sigma[:, 0], "height": 2.0 * sigma[:, 1]}
    )
    source.data["name"] = [mode.name for mode in found]
    chart.add_layout(BoxAnnotation(left=0.0, fill_color=COLORS["fault"], fill_alpha=0.08))
    size = {"width": "width", "height": "height"}
    chart.ellipse("re", "im", **size, source=source, color=COLORS["tick"], fill_alpha=0.25)
    drawn = chart.scatter("re", "im", source=source, size=8, marker="x", color=COLORS["tick"])
    hover(chart, drawn, ("", "@name"), ("real", "@re{0.000}"), ("imaginary", "@im{0.000}"))
    return Chart("mode-plane", "Modes in the complex plane", chart)


def _span(values: FloatArray) -> tuple[float, float]:
    low, high = (float(v) for v in np.percentile(values, SHARE))
    room = 0.05 * (high - low) or 1.0
    return low - room, high + room


def delay_chart(
    delays: FloatArray,  # (J,) Delays of the bank, s
    errors: FloatArray,  # (J, 3) Their squared prediction errors of p, q, r; or empty
    in_use: float,  # Delay in use at the end, s
) -> Chart | None:
    """Return the prediction error over the delay of the inputs; None if it does not vary."""
    if not len(errors) or not (errors > 0.0).all():
        return None
    root = np.sqrt(errors)
    rows = 100.0 * (root / root.min(axis=0) - 1.0)
    if rows.max() <= SMALLEST_RISE:
        return None
    mean = np.exp(np.log(root).mean(axis=1))  # the criterion of the estimate
    together = 100.0 * (mean / mean.min() - 1.0)
    top = min(1.05 * float(rows.max()), LARGEST_RISE)
    unit = "prediction error above its least [%]"
    chart = plain_figure(230, "delay [ms]", unit, y_range=(0.0, top))
    lines = {**dict(zip(RATES, rows.T, strict=True)), "all": together}
    _lines(chart, 1e3 * delays, lines, "delay [ms]")
    chart.add_layout(
        Span(dimension="height", location=1e3 * in_use, line_color=COLORS["ahead"], line_width=2)
    )
    return Chart("delay-curve", "Prediction error over delay", chart)
