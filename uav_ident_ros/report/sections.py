# SPDX-License-Identifier: Apache-2.0
"""The sections of the report, in the order of the questions that they answer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element

from uav_ident_ros.identification.structure import ROWS
from uav_ident_ros.report.coefficients_chart import coefficients_chart
from uav_ident_ros.report.coefficients_chart import height as coefficients_height
from uav_ident_ros.report.coverage import HEIGHT as COVERAGE_HEIGHT
from uav_ident_ros.report.coverage import coverage_chart
from uav_ident_ros.report.delay_curve import HEIGHT as DELAY_HEIGHT
from uav_ident_ros.report.delay_curve import delay_chart, tells_delays_apart
from uav_ident_ros.report.drawing import FORMATS
from uav_ident_ros.report.figures import figure
from uav_ident_ros.report.flight import AXES, Flight
from uav_ident_ros.report.markup import Node, element, number
from uav_ident_ros.report.predictions import Predictions, predict
from uav_ident_ros.report.provenance import bag_files, versions
from uav_ident_ros.report.rates_chart import HEIGHT as RATES_HEIGHT
from uav_ident_ros.report.rates_chart import rates_chart
from uav_ident_ros.report.spectra import HEIGHT as SPECTRA_HEIGHT
from uav_ident_ros.report.spectra import spectra, spectra_chart
from uav_ident_ros.report.strip import STATES
from uav_ident_ros.report.tables import (
    coefficients_table,
    correlations_table,
    fit_table,
    messages_table,
    provenance_tables,
    settings_tables,
    signals_table,
)

if TYPE_CHECKING:  # replay imports the report
    from uav_ident_ros.replay.evidence import Evidence

NBSP = "\u00a0"
"""A blank at which no line is broken: between a number and its unit."""

HORIZON = 1.0
"""How far ahead the score of record predicts, s."""


def sections(
    flight: Flight, bag: Path, summary: Mapping[str, Any], evidence: Evidence
) -> Iterator[Element]:
    """Yield the sections; parameters as in `write_report`, with the flight collected."""
    second = predict(flight, HORIZON)
    tick = predict(flight, 1.0 / flight.settings.update_rate)
    yield _fit_section(flight, summary, tick)
    yield _rates_section(flight, summary, second, tick)
    yield _coefficients_section(flight, summary)
    yield _inputs_section(flight)
    yield _delay_section(evidence)
    yield _section("messages", "Messages", messages_table(summary))
    yield _section("settings", "Settings", *settings_tables(summary))
    yield _section("origin", "Origin", *provenance_tables(bag_files(bag), versions()))


def _section(identity: str, heading: str, *children: Node) -> Element:
    return element("section", element("h2", heading), *children, id=identity)


def _fit_section(flight: Flight, summary: Mapping[str, Any], tick: Predictions) -> Element:
    fits = summary["prediction_fit"]
    end = flight.span[1]
    last, settled = fits["last_40_percent"], fits["after_30_s"]
    return _section(
        "fit",
        "Fit",
        element("ul", *(_card(last, axis) for axis in AXES), class_="cards"),
        element(
            "p",
            "How well the model predicts the measured rates one second ahead, over the last "
            f"40{NBSP}% of the flight: 100{NBSP}% is perfect, 0{NBSP}% no better than the mean. "
            "The mark on the bar is what simply holding the rates would reach.",
            class_="note",
        ),
        element(
            "div",
            fit_table(f"Last 40 % of the flight, {last['windows']} windows", last, tick, end),
            fit_table(f"After 30 s, {settled['windows']} windows", settled, None, end),
            class_="side",
        ),
    )


def _card(fit: Mapping[str, Any], axis: str) -> Element:
    model, hold = fit["model"][axis], fit["hold"][axis]
    share, mark = (min(max(value or 0.0, 0.0), 100.0) for value in (model, hold))
    return element(
        "li",
        element("span", {"p": "roll", "q": "pitch", "r": "yaw"}[axis], f", {axis}"),
        element("span", number(model, ".1f", f"{NBSP}%"), class_="value"),
        element(
            "span",
            element("span"),
            element("i"),
            class_="bar",
            style=f"--share:{share:.1f};--hold:{mark:.1f}",
            aria_hidden="true",
        ),
        element("span", "holding: ", number(hold, ".1f", f"{NBSP}%"), class_="beside"),
    )


def _rates_section(
    flight: Flight, summary: Mapping[str, Any], second: Predictions, tick: Predictions
) -> Element:
    fit = summary["prediction_fit"]["last_40_percent"]
    charts = [
        figure(
            f"rates-{axis}",
            rates_chart(flight, k, second, tick),
            RATES_HEIGHT,
            heading=f"{name} rate {axis}",
            spoken=f"Measured and predicted {name.lower()} rate {axis} over time with residuals. "
            f"Fit one second ahead {_spoken(fit['model'][axis])}, holding the rate "
            f"{_spoken(fit['hold'][axis])}.",
            caption="" if k else _RATES_CAPTION.format(tick=tick.horizon),
            legend=(
                ("measured", "measured"),
                ("predicted 1 s before", "ahead"),
                ("predicted one tick before", "tick"),
            ),
        )
        for k, (axis, name) in enumerate(zip(AXES, ("Roll", "Pitch", "Yaw"), strict=True))
    ]
    return _section("rates", "Rates, measured and predicted", *charts)


def _spoken(percent: float | None) -> str:
    return "unknown" if percent is None else f"{percent:.0f} percent"


_RATES_CAPTION = (
    "Every prediction starts from the measured rates, 1 s or one tick ({tick:g} s) before, with "
    "the coefficients known then and the inputs measured since. Residuals are measured minus "
    "predicted. The detail is the liveliest stretch of the last 40 %. Axes of the body: forward, "
    "right, down."
)


def _coefficients_section(flight: Flight, summary: Mapping[str, Any]) -> Element:
    caption = _COEFFICIENTS_CAPTION
    airspeed = flight.settings.airspeed
    if airspeed.type:
        caption += (
            " The charts are at the airspeed flown, the table is at the reference, "
            f"{airspeed.reference:g}{NBSP}m/s."
        )
    charts = [
        figure(
            f"coefficients-{row}",
            coefficients_chart(flight, k),
            {form.name: coefficients_height(flight, k, form) for form in FORMATS},
            heading=f"Coefficients of {row}",
            spoken=f"Coefficients of {row} over time, each with a band of one sigma. The last "
            "values are in the table above.",
            caption="" if k else caption,
            legend=tuple((state, state) for state in STATES),
        )
        for k, row in enumerate(ROWS)
    ]
    return _section("coefficients", "Coefficients", coefficients_table(summary), *charts)


_COEFFICIENTS_CAPTION = (
    "The band is one standard deviation to either side. The strip under the coefficients shows the "
    "state, when the model was usable, and how much each input moved over three seconds, each "
    "relative to its own liveliest moment."
)


def _inputs_section(flight: Flight) -> Element:
    found = spectra(flight)
    children: list[Node] = []
    if found is not None:
        children.append(
            figure(
                "spectra",
                spectra_chart(flight, found),
                SPECTRA_HEIGHT,
                heading="Spectra",
                spoken="Power densities of the inputs and of the rates over frequency.",
                caption="The dotted line is the cut-off of the estimator's filter: what is above "
                "it teaches little.",
            )
        )
    children.append(
        figure(
            "coverage",
            coverage_chart(flight),
            COVERAGE_HEIGHT,
            heading="Coverage",
            spoken="How often pairs of inputs and of rates had which values.",
            caption="Where the flight was: the model is known there and nowhere else. A line "
            "instead of a cloud means that the two moved together and cannot be told apart.",
        )
    )
    children += [
        element("div", signals_table(flight, found), correlations_table(flight), class_="side"),
        element(
            "p",
            "The band holds the middle 80 % of a signal's power. An input that is strongly "
            "correlated with another, or with a rate that an autopilot feeds back, teaches little.",
            class_="note",
        ),
    ]
    return _section("inputs", "Inputs", *children)


def _delay_section(evidence: Evidence) -> Element:
    found, residual, in_use = evidence.delay, evidence.delay_residual, evidence.delay_in_use
    if not tells_delays_apart(residual):
        return _section("delay", "Delay", element("p", "Too little to tell delays apart."))
    text = (
        f"Least residual at {1e3 * found.delay:.0f} ms, sigma {1e3 * found.sigma:.0f} ms, "
        f"confidence {found.confidence}; in use at the end: {1e3 * in_use:.0f} ms."
    )
    return _section(
        "delay",
        "Delay",
        element("p", text),
        figure(
            "delay-curve",
            delay_chart(evidence.delays, residual, in_use),
            dict.fromkeys(("wide", "narrow"), DELAY_HEIGHT),
            heading="Residual over delay",
            spoken=text,
            caption="How much worse the equations of motion are met when the inputs are taken that "
            "much later. A sharp valley is a known delay, a flat one is not.",
        ),
    )
