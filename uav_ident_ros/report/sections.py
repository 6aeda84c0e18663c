# SPDX-License-Identifier: Apache-2.0
"""The sections of the report, in the order of the questions that they answer."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uav_ident_ros
from uav_ident_ros.files.truth_file import read_truth
from uav_ident_ros.identification.linearisation import level_modes
from uav_ident_ros.offline.done import bag_files
from uav_ident_ros.report import diagrams, tables
from uav_ident_ros.report.analysis import spectra
from uav_ident_ros.report.charts import (
    AXIS_WORDS,
    coefficient_charts,
    rate_charts,
    signal_charts,
    state_chart,
)
from uav_ident_ros.report.flight import AXES, Flight
from uav_ident_ros.report.predictions import predict
from uav_ident_ros.report.timeline import Chart, Timeline

if TYPE_CHECKING:  # replay imports the report
    from uav_ident_ros.offline.evidence import Evidence

HORIZON = 1.0
"""How far ahead the score of record predicts, s."""

LOWEST_SHOWN = -100.0
"""Fit below which the number says nothing more, percent."""


@dataclass(frozen=True)
class Section:
    """A section of the page: cards, words, tables, then charts."""

    id: str
    heading: str
    texts: Sequence[str] = ()
    tables: Sequence[tables.Table] = ()
    charts: Sequence[Chart] = ()
    cards: Sequence[Mapping[str, str]] = ()


def sections(
    flight: Flight, bag: Path, summary: Mapping[str, Any], evidence: Evidence
) -> Iterator[Section]:
    """Yield the sections; parameters as in `write_report`, with the flight collected."""
    line = Timeline(flight.span, flight.clock.restarts)
    second, tick = predict(flight, HORIZON), predict(flight, 1.0 / flight.settings.update_rate)
    fit = summary["prediction_fit"]["last_40_percent"]
    yield Section(
        "fit",
        "Fit",
        [_FIT_TEXT],
        [*tables.fit_tables(summary, tick, flight.span[1])],
        cards=[_card(fit, axis) for axis in AXES],
    )
    states = state_chart(flight, line, evidence.lost)
    yield Section("learning", "Learning", [], [tables.gates_table(evidence.lost)], [states])
    whiteness = diagrams.whiteness_chart(flight, tick)
    charts = [*rate_charts(flight, line, second, tick), *([whiteness] if whiteness else [])]
    yield Section("rates", "Rates, measured and predicted", [_RATES_TEXT], [], charts)
    truth = read_truth(bag, flight.structure)
    coefficients = [*coefficient_charts(flight, line, truth)]
    text = _COEFFICIENTS_TEXT
    if flight.settings.airspeed.type:
        text += (
            " The charts are at the airspeed flown, the table is at the reference, "
            f"{flight.settings.airspeed.reference:g} m/s."
        )
    known = [*tables.coefficient_correlations(evidence)]
    table = tables.coefficients_table(summary, truth)
    yield Section("coefficients", "Coefficients", [text], [table, *known], coefficients)
    yield from _modes_section(flight)
    found = spectra(flight)
    charts = [*signal_charts(flight, line)]
    charts += [*diagrams.spectrum_charts(flight, found)] if found is not None else []
    charts += [*diagrams.coverage_charts(flight)]
    numbers = [tables.signals_table(flight, found), tables.correlations_table(flight)]
    yield Section("inputs", "Inputs, forces and states", [_INPUTS_TEXT], numbers, charts)
    yield _delay_section(evidence)
    yield Section("messages", "Messages", [], [tables.messages_table(summary)])
    yield Section("settings", "Settings", [], [*tables.settings_tables(summary)])
    yield Section("origin", "Origin", [], [*tables.origin_tables(bag_files(bag), versions())])


def _card(fit: Mapping[str, Any], axis: str) -> dict[str, str]:
    model, hold = fit["model"][axis], fit["hold"][axis]
    share, mark = (min(max(value or 0.0, 0.0), 100.0) for value in (model, hold))
    shown = tables.number(model, ".1f", " %")
    if model is not None and model < LOWEST_SHOWN:
        shown = "diverges"
    return {
        "axis": f"{AXIS_WORDS[axis].lower()}, {axis}",
        "value": shown,
        "share": f"{share:.1f}",
        "mark": f"{mark:.1f}",
        "beside": "holding: " + tables.number(hold, ".1f", " %"),
    }


_FIT_TEXT = (
    "How well the model predicts the measured rates over the last 40 % of the flight: 100 % is "
    "perfect, 0 % no better than the mean. The prediction is free: from the start of each window "
    "nothing measured enters but the inputs. Above, it is that over 1 s; the mark on the bar is "
    "what simply holding the rates would reach."
)

_RATES_TEXT = (
    "Every prediction starts from the measured rates, 1 s or one tick before, with the "
    "coefficients known then and the inputs measured since. Residuals are measured minus "
    "predicted. Axes of the body: forward, right, down."
)

_COEFFICIENTS_TEXT = (
    "The band is one standard deviation to either side, the dashed line the true value, where the "
    "bag is simulated. A coefficient with a t-ratio below three is printed pale."
)

_INPUTS_TEXT = (
    "The band holds the middle 80 % of a signal's power; the dotted line in the spectra is the "
    "cut-off of the estimator's filter. An input that is strongly correlated with another, or with "
    "a rate that an autopilot feeds back, teaches little. The model is known where the clouds of "
    "the coverage are, and nowhere else."
)


def _modes_section(flight: Flight) -> Iterator[Section]:
    """Yield the modes of the last model; nothing for a structure without flow angles."""
    last = flight.estimates[-1]
    airspeed = last.flow.airspeed if last.flow is not None else 0.0
    found = level_modes(flight.structure, last.coefficients, last.sigma, airspeed)
    if found:
        charts = [diagrams.mode_chart(found)]
        yield Section("modes", "Modes", [_MODES_TEXT], [tables.modes_table(found)], charts)


_MODES_TEXT = (
    "The identified model, linearised in level flight at the airspeed of the last tick. The "
    "coefficients count as independent in the standard deviations."
)


def _delay_section(evidence: Evidence) -> Section:
    found, errors, in_use = evidence.delay, evidence.delay_errors, evidence.delay_in_use
    if not diagrams.tells_delays_apart(errors):
        return Section("delay", "Delay", ["Too little to tell delays apart."])
    text = (
        f"Best prediction at {1e3 * found.delay:.0f} ms, sigma {1e3 * found.sigma:.0f} ms, "
        f"confidence {found.confidence}; in use at the end: {1e3 * in_use:.0f} ms."
    )
    chart = diagrams.delay_chart(evidence.delays, errors, in_use, text)
    return Section("delay", "Delay", [text], charts=[chart])


PACKAGES = ("numpy", "rosbags", "bokeh")
"""Packages that the numbers or the pictures depend on."""


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of what it computes and draws with."""
    found = {"uav_ident_ros": uav_ident_ros.__version__, "Python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "unknown"
    return found
