# SPDX-License-Identifier: Apache-2.0
"""The charts over time: rates, inputs, forces, states, coefficients, and times of learning."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby

import numpy as np
from bokeh.models import ColumnDataSource, Span

from uav_ident_ros.files.meanings import AXIS_WORDS
from uav_ident_ros.identification.prediction import LAST_PART
from uav_ident_ros.identification.structure import INPUTS, RATES, ROWS, SPECIFIC_FORCES
from uav_ident_ros.offline.evidence import reason_of
from uav_ident_ros.report.flight import Predictions, ReplayedFlight
from uav_ident_ros.report.style import COLORS
from uav_ident_ros.report.timeline import Chart, Timeline, columns, hover, value_range

RATE_BINS = (9.0, 15_000)
"""Bins of a line of gyro samples: per second, and at most. A bin keeps two points."""

TICK_BINS = (5.0, 9_000)
"""Bins of a line of predictions, inputs, forces or states, likewise."""

COEFFICIENT_POINTS = 300
"""Ticks drawn of a coefficient: it moves slowly."""

STRIP_BINS = 600
"""Bins of the chart of states."""

SETTLED_SHARE = 0.3
"""Share of the flight at its start that is ignored in the range of an axis: the first estimates
scatter."""

BAND_SHARE = 95.0
"""Percentile of the settled band that the axis of a coefficient spans."""

RATE_HEADROOM = 1.35
"""Range of the axis of rates over that of the measured ones: a divergent prediction leaves it."""

RESIDUAL_SHARE = 99.5
"""Percentile of the residuals of the last 40 % of the flight that their axis spans."""

SMALLEST_RANGE = 1e-3
"""Least half-range of an axis of rates, rad/s."""

GRAVEST = ("fault", "waiting", "paused", "learning", "converged")
"""States in the order of severity: of several in a bin the first is shown."""

MOST_REASONS = 6
"""Number of reasons not to learn with a row of their own, the longest first."""

UNITS = {
    **dict.fromkeys(RATES, "rad/s"),
    **dict.fromkeys(SPECIFIC_FORCES, "m/s²"),
    **dict.fromkeys(("alpha", "beta", "roll", "pitch"), "rad"),
    "airspeed": "m/s",
}
"""Units of signals; an input's is that of its channels."""


def rate_charts(flight: ReplayedFlight, line: Timeline, tick: Predictions) -> Iterator[Chart]:
    """Yield the charts of rates with predictions, and of residuals, for each axis."""
    second = flight.ahead
    for k, (axis, word) in enumerate(zip(RATES, AXIS_WORDS.values(), strict=True)):
        measured = flight.rates[:, k]
        limit = RATE_HEADROOM * max(float(np.abs(measured).max(initial=0.0)), SMALLEST_RANGE)
        chart = line.figure(f"{axis} [rad/s]", 220, y_range=(-limit, limit))
        gyro = line.source(flight.t, {"measured": measured}, RATE_BINS)
        both = {"predicted": second.predicted[:, k], "residual": second.residual[:, k]}
        ahead = line.source(second.t, both, TICK_BINS)
        legend = (
            line.line(chart, gyro, "measured", "measured", line_width=1.8),
            line.line(chart, ahead, "predicted", "ahead", name="predicted 1 s before"),
        )
        yield Chart(f"rates-{axis}", f"{word.capitalize()} rate {axis}", chart, legend=legend)
        reach = max(_reach(flight, prediction, k) for prediction in (second, tick))
        reach = min(max(RATE_HEADROOM * reach, SMALLEST_RANGE), limit)
        chart = line.figure("[rad/s]", 120, y_range=(-reach, reach))
        short = line.source(tick.t, {"residual": tick.residual[:, k]}, TICK_BINS)
        legend = (
            line.line(chart, ahead, "residual", "ahead", name="1 s ahead"),
            line.line(chart, short, "residual", "tick", name="one tick ahead"),
        )
        yield Chart(f"residual-{axis}", f"Residual of {axis}", chart, legend=legend)


def _reach(flight: ReplayedFlight, prediction: Predictions, axis: int) -> float:
    """Return the largest residual of an axis in the last part of the flight, without outliers."""
    settled = prediction.t >= flight.span[1] * (1.0 - LAST_PART)
    residuals = np.abs(prediction.residual[settled, axis])
    return float(np.percentile(residuals, RESIDUAL_SHARE)) if len(residuals) else 0.0


def signal_charts(flight: ReplayedFlight, line: Timeline) -> Iterator[Chart]:
    """Yield the charts of inputs, specific forces and published states."""
    groups = (
        ("input", flight.t, dict(zip(INPUTS, flight.u.T, strict=True)), "tick"),
        ("force", flight.t, dict(zip(SPECIFIC_FORCES, flight.force.T, strict=True)), "measured"),
        ("state", flight.tick_t, flight.states, "truth"),
    )
    for kind, t, signals, color in groups:
        moved = {name: values for name, values in signals.items() if np.ptp(values) > 0.0}
        if not moved:
            continue
        source = line.source(t, moved, TICK_BINS)
        for name, values in moved.items():
            unit = f" [{UNITS[name]}]" if name in UNITS else ""
            chart = line.figure(f"{name}{unit}", 130, y_range=value_range(values))
            line.line(chart, source, name, color)
            yield Chart(f"{kind}-{name}", f"{kind.capitalize()} {name}", chart)


def coefficient_charts(
    flight: ReplayedFlight, line: Timeline, truth: Mapping[str, float]
) -> Iterator[Chart]:
    """Yield the charts of all coefficients, with a band of one sigma and any true value."""
    kept = np.linspace(0, len(flight.tick_t) - 1, COEFFICIENT_POINTS).round().astype(int)
    kept = np.unique(kept)
    structure, t = flight.structure, flight.tick_t[kept]
    for name, index in structure.places.items():
        value, sigma = (history[kept] for history in flight.estimates.history(index))
        low, high = value - sigma, value + sigma
        true = [truth[name]] * 2 if name in truth else []
        chart = line.figure("", 130)
        settled = t >= t[0] + SETTLED_SHARE * (t[-1] - t[0])
        bottom = np.percentile(low[settled], 100.0 - BAND_SHARE)
        top = np.percentile(high[settled], BAND_SHARE)
        chart.y_range = value_range(np.array([bottom, top, 0.0, *true]))
        chart.xaxis.axis_label = None
        chart.min_border_left = 0
        source = columns({"t": t, "value": value, "low": low, "high": high})
        chart.varea("t", "low", "high", source=source, color=COLORS["tick"], alpha=0.25)
        chart.add_layout(Span(dimension="width", location=0.0, line_color=COLORS["muted"]))
        line.line(chart, source, "value", "tick", name=name, line_width=1.5)
        if true:
            known = columns({"t": flight.span, "true": true})
            line.line(chart, known, "true", "truth", line_dash="dashed", line_width=1.5)
        yield Chart(f"coefficient-{name.replace('/', '-')}", name, chart, small=True)


# -- times of learning -------------------------------------------------------------------------


def state_chart(flight: ReplayedFlight, line: Timeline, reasons: Iterable[str]) -> Chart:
    """Return the chart of the state, the verdicts and the main reasons not to learn."""
    rows = {
        "state": [estimate.state for estimate in flight.estimates],
        "usable": ["converged" if estimate.usable else "" for estimate in flight.estimates],
    }
    verdicts = zip(*(estimate.usable_rows for estimate in flight.estimates), strict=True)
    for row, usable in zip(ROWS, verdicts, strict=True):
        rows[f"usable {row}"] = ["converged" if flag else "" for flag in usable]
    given = [reason_of(estimate) for estimate in flight.estimates]
    for reason in [r for r in reasons if r][:MOST_REASONS]:
        rows[reason] = ["paused" if other == reason else "" for other in given]
    edges = np.linspace(*flight.span, STRIP_BINS + 1)
    place = np.searchsorted(edges, flight.tick_t, side="right") - 1
    bins = np.clip(place, 0, STRIP_BINS - 1).tolist()
    labels = {name: name if len(name) <= 24 else f"{name[:23]}…" for name in rows}
    bars = [
        (labels[name], COLORS[word], word if name == "state" else name, edges[first], edges[end])
        for name, words in rows.items()
        for word, first, end in _runs(bins, words)
    ]
    columns = zip(("row", "color", "words", "begin", "end"), zip(*bars, strict=True), strict=True)
    factors = list(dict.fromkeys(reversed(labels.values())))
    chart = line.figure("", 60 + 20 * len(factors), y_range=factors)
    drawn = chart.hbar(
        "row", left="begin", right="end", height=0.8, color="color", line_width=0,
        source=ColumnDataSource({name: list(column) for name, column in columns}),
    )  # fmt: skip
    hover(chart, drawn, ("", "@words"), ("from", "@begin{0.0} s"), ("to", "@end{0.0} s"))
    return Chart(
        "states",
        "State, verdict, and reasons not to learn",
        chart,
        legend=tuple((state, state) for state in reversed(GRAVEST)),
    )


def _runs(bins: Iterable[int], words: Iterable[str]) -> Iterator[tuple[str, int, int]]:
    """Yield every run of bins with one state: the state, its first bin, the bin after its last."""
    gravest = [""] * STRIP_BINS
    for k, word in zip(bins, words, strict=True):
        if word and (not gravest[k] or GRAVEST.index(word) < GRAVEST.index(gravest[k])):
            gravest[k] = word
    for word, run in groupby(range(STRIP_BINS), key=gravest.__getitem__):
        places = list(run)
        if word:
            yield word, places[0], places[-1] + 1
