# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one file that any browser opens, from a memory stick, without a network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from uav_ident_ros.bag_writer import BagWriteError
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.structure import ROWS
from uav_ident_ros.offline import OfflineRun
from uav_ident_ros.report.coefficients_chart import coefficients_chart
from uav_ident_ros.report.coefficients_chart import height as coefficients_height
from uav_ident_ros.report.coverage import HEIGHT as COVERAGE_HEIGHT
from uav_ident_ros.report.coverage import coverage_chart
from uav_ident_ros.report.delay_curve import HEIGHT as DELAY_HEIGHT
from uav_ident_ros.report.delay_curve import delay_chart, tells_delays_apart
from uav_ident_ros.report.drawing import FORMATS
from uav_ident_ros.report.figures import figure
from uav_ident_ros.report.flight import AXES, Flight, collect
from uav_ident_ros.report.markup import Node, element, number
from uav_ident_ros.report.predictions import Predictions, predict
from uav_ident_ros.report.provenance import bag_files, versions
from uav_ident_ros.report.rates_chart import HEIGHT as RATES_HEIGHT
from uav_ident_ros.report.rates_chart import rates_chart
from uav_ident_ros.report.spectra import HEIGHT as SPECTRA_HEIGHT
from uav_ident_ros.report.spectra import spectra, spectra_chart
from uav_ident_ros.report.strip import STATES
from uav_ident_ros.report.style import style_sheet
from uav_ident_ros.report.tables import (
    coefficients_table,
    correlations_table,
    fit_table,
    messages_table,
    provenance_tables,
    settings_tables,
    signals_table,
)

if TYPE_CHECKING:  # replay imports this module
    from uav_ident_ros.replay.evidence import Evidence

HORIZON = 1.0
"""How far ahead the score of record predicts, s."""

EARLIEST_DATE_NS = 946_684_800_000_000_000
"""The year 2000, ns: earlier stamps count from the start of a computer and say no date."""


def write_report(
    path: Path, bag: Path, run: OfflineRun, summary: Mapping[str, Any], evidence: Evidence
) -> None:
    """Write the report of a replay.

    Parameters
    ----------
    path : Path
        The file; its folder exists.
    bag : Path
        The bag that was replayed.
    run : OfflineRun
        The replay, with at least one estimate.
    summary : mapping
        Content of its summary.json.
    evidence : Evidence
        What the flight measures of itself.

    Raises
    ------
    BagError
        If the bag cannot be read again, for its hash.
    BagWriteError
        If the file cannot be written.
    PictureError
        If matplotlib is missing.
    """
    page = _page(collect(str(summary["bag"]), run), bag, summary, evidence)
    text = ElementTree.tostring(page, encoding="unicode", method="html")
    try:
        path.write_text(f"<!doctype html>\n{text}\n", encoding="utf-8")
    except OSError as error:
        raise BagWriteError(f"cannot write '{path}': {error.strerror}") from None


def _page(flight: Flight, bag: Path, summary: Mapping[str, Any], evidence: Evidence) -> Element:
    sections = list(_sections(flight, bag, summary, evidence))
    links = [
        element("li", element("a", str(section[0].text), href=f"#{section.get('id')}"))
        for section in sections
    ]
    return element(
        "html",
        element(
            "head",
            element("meta", charset="utf-8"),
            element("meta", name="viewport", content="width=device-width, initial-scale=1"),
            element("title", f"{flight.name}: identification report"),
            element("style", style_sheet()),
        ),
        element(
            "body",
            _header(flight, summary, element("nav", element("ul", *links), aria_label="Contents")),
            element("main", *sections),
            element("footer", "Written by replay of uav_ident_ros."),
        ),
        lang="en",
    )


def _header(flight: Flight, summary: Mapping[str, Any], nav: Element) -> Element:
    seconds = (summary["last_tick_ns"] - summary["first_tick_ns"]) * NS
    facts = [f"{seconds:.0f} s of flight", f"{summary['ticks']} ticks"]
    if summary["first_tick_ns"] > EARLIEST_DATE_NS:
        start = datetime.fromtimestamp(summary["first_tick_ns"] * NS, tz=UTC)
        facts.insert(0, f"{start:%Y-%m-%d %H:%M} UTC")
    facts.append(f"{flight.settings.estimator}, {flight.settings.structure}")
    usable = bool(summary["usable"])
    words = "Usable" if usable else "Not usable"
    reason = summary["reason"] or "a controller could have acted on the last estimate"
    return element(
        "header",
        element("h1", flight.name),
        element("p", " · ".join(facts), class_="lead"),
        element(
            "div",
            element("p", element("strong", words), f": {reason}"),
            element("p", f"State at the end: {summary['state']}.", class_="note"),
            *_advice(summary),
            class_="verdict usable" if usable else "verdict",
        ),
        nav,
    )


def _advice(summary: Mapping[str, Any]) -> Iterator[Element]:
    """Yield what to do about the model, and what the bag is like, if there is anything."""
    said = [entry["text"] for entry in summary["advice"]]
    for heading, entries in (("Advice", said), ("The bag", summary["notes"])):
        if entries:
            yield element("h2", heading)
            yield element("ul", *(element("li", _sentence(text)) for text in entries))


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _section(identity: str, heading: str, *children: Node) -> Element:
    return element("section", element("h2", heading), *children, id=identity)


def _sections(
    flight: Flight, bag: Path, summary: Mapping[str, Any], evidence: Evidence
) -> Iterator[Element]:
    second = predict(flight, HORIZON)
    tick = predict(flight, 1.0 / flight.settings.update_rate)
    yield _fit_section(flight, summary, tick)
    yield _rates_section(flight, second, tick)
    yield _coefficients_section(flight, summary)
    yield _inputs_section(flight)
    yield _delay_section(evidence)
    yield _section("messages", "Messages", messages_table(summary))
    yield _section("settings", "Settings", *settings_tables(summary))
    yield _section("origin", "Origin", *provenance_tables(bag_files(bag), versions()))


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
            "How well the model predicts the measured rates one second ahead, over the last 40 % "
            "of the flight: 100 % is perfect, 0 % no better than the mean. The mark on the bar is "
            "what simply holding the rates would reach.",
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
        element("span", number(model, ".1f", " %"), class_="value"),
        element(
            "span",
            element("span"),
            element("i"),
            class_="bar",
            style=f"--share:{share:.1f};--hold:{mark:.1f}",
            aria_hidden="true",
        ),
        element("span", "holding: ", number(hold, ".1f", "\u00a0%"), class_="beside"),
    )


def _rates_section(flight: Flight, second: Predictions, tick: Predictions) -> Element:
    charts = [
        figure(
            f"rates-{axis}",
            rates_chart(flight, k, second, tick),
            RATES_HEIGHT,
            heading=f"{name} rate {axis}",
            spoken=f"Measured and predicted {name.lower()} rate {axis} over time with residuals.",
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


_RATES_CAPTION = (
    "Every prediction starts from the measured rates, 1 s or one tick ({tick:g} s) before, with "
    "the coefficients known then and the inputs measured since. Residuals are measured minus "
    "predicted. The detail is the liveliest stretch of the last 40 %. Axes of the body: forward, "
    "right, down."
)


def _coefficients_section(flight: Flight, summary: Mapping[str, Any]) -> Element:
    charts = [
        figure(
            f"coefficients-{row}",
            coefficients_chart(flight, k),
            {form.name: coefficients_height(flight, k, form) for form in FORMATS},
            heading=f"Coefficients of {row}",
            spoken=f"Coefficients of {row} over time, each with a band of one sigma.",
            caption="" if k else _COEFFICIENTS_CAPTION,
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
