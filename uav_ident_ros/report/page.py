# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one file that any browser opens, from a memory stick, without a network."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.offline.picture import PictureError
from uav_ident_ros.offline.run import OfflineRun

if TYPE_CHECKING:  # replay imports the report
    from uav_ident_ros.offline.evidence import Evidence
    from uav_ident_ros.report.flight import Flight
    from uav_ident_ros.report.timeline import Chart

EARLIEST_DATE_NS = 946_684_800_000_000_000
"""The year 2000, ns: earlier stamps count from the start of a computer and say no date."""

_NAMES = re.compile(r'(?<=")p\d{4,}(?=")')
"""Names that Bokeh makes up for its models, anew in every run."""


def write_report(
    path: Path,  # The file; its folder exists
    bag: Path,  # The bag that was replayed
    run: OfflineRun,  # The replay, with at least one estimate
    summary: Mapping[str, Any],  # Content of its summary.json
    evidence: Evidence,  # What the flight measures of itself
) -> None:
    """Write the report of a replay.

    Raises
    ------
    BagError
        If the bag cannot be read again, for its hash.
    BagWriteError
        If the file cannot be written.
    PictureError
        If Bokeh or Jinja2 is missing.
    """
    try:
        from uav_ident_ros.report import flight as flights
        from uav_ident_ros.report import sections as parts
        from uav_ident_ros.report.tables import verdict_of
    except ImportError as error:
        raise PictureError(
            f"the report needs bokeh and jinja2 (pip install bokeh jinja2): {error}"
        ) from None
    flight = flights.collect(str(summary["bag"]), run)
    text = render(
        "page.html",
        [*parts.sections(flight, bag, summary, evidence)],
        name=flight.name,
        facts=_facts(flight, summary),
        verdict=verdict_of(summary),
        advice=[entry["text"] for entry in summary["advice"]],
        notes=summary["notes"],
    )
    write_page(path, text)


def write_page(path: Path, text: str) -> None:
    """Write a page; raises `BagWriteError` if it cannot be written."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BagWriteError(f"cannot write '{path}': {error.strerror}") from None


def render(template: str, sections: Sequence[Any], **content: Any) -> str:
    """Return a page with the charts of its sections, and all that they need.

    Parameters
    ----------
    template : str
        One of the templates.
    sections : sequence of Section
        The sections.
    content : Any
        What else the template asks for.
    """
    from jinja2 import Environment, PackageLoader

    from uav_ident_ros.report.style import COLORS
    from uav_ident_ros.report.tables import WORDY, cell

    loader = PackageLoader("uav_ident_ros.report")
    page = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    page.filters |= {"cell": cell, "sentence": _sentence}
    drawn, names = _embed([chart for section in sections for chart in section.charts])
    return page.get_template(template).render(
        sections=sections,
        colors=COLORS,
        style=page.get_template("style.css").render(),
        library=_library(),
        script=page.get_template("charts.js").render(),
        drawn=drawn,
        names=names,
        wordy=WORDY,
        **content,
    )


def _embed(charts: Iterable[Chart]) -> tuple[str, dict[str, str]]:
    """Return the charts as JSON, and the name of each in it; both are the same in every run."""
    from bokeh.core.json_encoder import serialize_json
    from bokeh.document import Document

    document, roots = Document(), {chart.identity: chart.model for chart in charts}
    for model in roots.values():
        document.add_root(model)
    seen: dict[str, str] = {}

    def named(made_up: str) -> str:
        return seen.setdefault(made_up, f"m{len(seen)}")

    text = serialize_json(document.to_json(deferred=False))
    text = _NAMES.sub(lambda found: named(found.group()), text)
    return text.replace("</", "<\\/"), {name: named(model.id) for name, model in roots.items()}


def _library() -> str:
    """Return Bokeh's own script, so that no network is needed."""
    from bokeh.resources import Resources

    return "\n".join(Resources(mode="inline", components=["bokeh"]).js_raw)


def _facts(flight: Flight, summary: Mapping[str, Any]) -> list[str]:
    """Return when the flight was, how long, and how it was identified."""
    seconds = (summary["last_tick_ns"] - summary["first_tick_ns"]) * NS
    facts = [f"{seconds:.0f} s of flight", f"{summary['ticks']} ticks"]
    if summary["first_tick_ns"] > EARLIEST_DATE_NS:
        start = datetime.fromtimestamp(summary["first_tick_ns"] * NS, tz=UTC)
        facts.insert(0, f"{start:%Y-%m-%d %H:%M} UTC")
    return [*facts, f"{flight.settings.estimator}, {flight.settings.structure}"]


def _sentence(text: str) -> str:
    """Return a sentence: a capital at its beginning, a full stop at its end."""
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
