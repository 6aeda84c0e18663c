# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one file for any browser, without a network."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml
from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.resources import Resources
from bokeh.themes import Theme
from jinja2 import Environment, PackageLoader

from uav_ident_ros.bags.writing import write_file
from uav_ident_ros.files.truth_file import read_truth
from uav_ident_ros.identification.delay import DelayBank
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.structure import RATES
from uav_ident_ros.offline.evidence import FIT_WINDOWS
from uav_ident_ros.offline.summary import Replayed
from uav_ident_ros.offline.tables import (
    Number,
    Table,
    Words,
    coefficients_table,
    duration_of,
    fit_tables,
    modes_table,
    told,
)
from uav_ident_ros.report import diagrams, tables
from uav_ident_ros.report.charts import coefficient_charts, rate_charts, signal_charts, state_chart
from uav_ident_ros.report.flight import predict
from uav_ident_ros.report.style import COLORS
from uav_ident_ros.report.timeline import Chart, Timeline


@dataclass(frozen=True)
class Section:
    """A section of the page: cards, texts, tables, then charts."""

    id: str
    heading: str
    tables: Sequence[Table] = ()
    charts: Sequence[Chart] = ()
    texts: Sequence[str] = ()  # Beyond those of the template
    cards: Sequence[tuple[str, Number, Number]] = ()


def sections(replayed: Replayed) -> Iterator[Section]:
    """Yield the sections of a replay."""
    summary, flight = replayed.summary, replayed.flight
    lost, identifier = replayed.evidence.lost, replayed.run.identifier
    line = Timeline(flight.span, flight.restarts)
    tick = predict(flight, 1.0 / flight.settings.update_rate)
    fit = summary["prediction_fit"][FIT_WINDOWS]
    cards = [tables.card(fit, axis) for axis in RATES]
    yield Section("fit", "Fit", [*fit_tables(summary)], cards=cards)
    states = state_chart(flight, line, lost)
    yield Section("learning", "Learning", [tables.gates_table(lost)], [states])
    whiteness = diagrams.whiteness_chart(flight, tick)
    charts = [*rate_charts(flight, line, tick), *([whiteness] if whiteness else [])]
    yield Section("rates", "Rates, measured and predicted", charts=charts)
    truth = read_truth(replayed.bag, flight.structure)
    coefficients = [*coefficient_charts(flight, line, truth)]
    texts, airspeed = [], flight.settings.airspeed
    if airspeed.type:
        at = f"{airspeed.reference:g} m/s"
        texts = [f"The charts are at the airspeed flown, the table is at the reference, {at}."]
    table = coefficients_table(summary, truth)
    known = [table, *tables.coefficient_correlations(identifier.estimator.information)]
    yield Section("coefficients", "Coefficients", known, coefficients, texts)
    if replayed.modes:
        charts = [diagrams.mode_chart(replayed.modes)]
        yield Section("modes", "Modes", [modes_table(summary)], charts)
    charts = [
        *signal_charts(flight, line),
        *diagrams.spectrum_charts(flight),
        *diagrams.coverage_charts(flight),
    ]
    numbers = [tables.correlations_table(flight)]
    yield Section("inputs", "Inputs, forces and states", numbers, charts)
    yield _delay_section(identifier.delays, identifier.delay)
    yield Section("messages", "Messages", [tables.messages_table(summary)])
    yield Section("settings", "Settings", [*tables.settings_tables(summary)])
    yield Section("origin", "Origin", [*tables.origin_tables(replayed.bag)])


def _delay_section(bank: DelayBank, in_use: float) -> Section:
    found, chart = bank.estimate, diagrams.delay_chart(bank.delays, bank.errors, in_use)
    text = "Too little excitation to separate delays."
    # Injected signals may have given the lag without a block of the bank since.
    if chart or found.lag_sure:
        text = (
            f"Best prediction at {1e3 * found.delay:.0f} ms, sigma {1e3 * found.sigma:.0f} ms, "
            f"confidence {found.confidence}; in use at the end: {1e3 * in_use:.0f} ms."
        )
    if found.lag_sure:
        text += (
            f" By the response to the injected signal the servos follow with a lag of "
            f"{1e3 * found.lag:.0f} ms, sigma {1e3 * found.lag_sigma:.0f} ms, after a delay of "
            f"{1e3 * max(found.total - found.lag, 0.0):.0f} ms."
        )
    return Section("delay", "Delay", [], [chart] if chart else [], [text])


# --- the page -------------------------------------------------------------------------------------


TEMPLATES = Environment(
    loader=PackageLoader("uav_ident_ros.report"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.tests["words"] = lambda heading: isinstance(heading, Words)

EARLIEST_DATE_NS = 946_684_800_000_000_000
"""The year 2000, ns: earlier stamps count from the start of a computer and are no dates."""

_NAMES = re.compile(r'(?<=")p\d{4,}(?=")')
"""Names that Bokeh gives to its models, different in every run."""


def write_report(path: Path, replayed: Replayed) -> None:
    """Write the report of a replay; raises `BagError` or `BagWriteError`."""
    summary = replayed.summary
    doubt, advice = told(summary)
    state = f" ({summary['reason']})" if summary["reason"] and not doubt else ""
    text = render(
        [*sections(replayed)],
        name=replayed.name,
        facts=_facts(summary),
        usable=not doubt,
        verdict=f"not usable: {doubt}" if doubt else "usable",
        state=f"State at the end: {summary['state']}{state}.",
        advice=advice,
        notes=summary["notes"],
    )
    write_file(path, text)


def render(sections: Sequence[Section], **content: Any) -> str:
    """Return a page with sections and their charts; `content` are further fields of the page."""
    drawn, names = _embed([chart for section in sections for chart in section.charts])
    return TEMPLATES.get_template("page.html").render(
        sections=sections,
        colors=COLORS,
        library="\n".join(Resources(mode="inline", components=["bokeh"]).js_raw),
        drawn=drawn,
        names=names,
        **content,
    )


def _embed(charts: Iterable[Chart]) -> tuple[str, dict[str, str]]:
    """Return the charts as JSON, and their names in it; both are the same in every run."""
    style = yaml.safe_load(TEMPLATES.get_template("theme.yaml").render(colors=COLORS))
    document, roots = Document(theme=Theme(json=style)), {c.identity: c.model for c in charts}
    with document.models.freeze():  # otherwise each root searches all models
        for model in roots.values():
            document.add_root(model)
    seen: dict[str, str] = {}

    def named(made_up: str) -> str:
        return seen.setdefault(made_up, f"m{len(seen)}")

    text = serialize_json(document.to_json(deferred=False))
    text = _NAMES.sub(lambda found: named(found.group()), text)
    return text.replace("<", "\\u003c"), {name: named(model.id) for name, model in roots.items()}


def _facts(summary: Mapping[str, Any]) -> list[str]:
    first_ns, settings = summary["first_tick_ns"], summary["settings"]
    facts = [
        f"{duration_of(summary):.0f} s of flight",
        f"{summary['ticks']} ticks",
        f"{settings['estimator']}, {settings['structure']}",
    ]
    if first_ns > EARLIEST_DATE_NS:
        facts.insert(0, f"{datetime.fromtimestamp(first_ns * NS, tz=UTC):%Y-%m-%d %H:%M} UTC")
    return facts
