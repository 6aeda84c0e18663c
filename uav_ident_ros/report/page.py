# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one file that any browser opens, from a memory stick, without a network."""

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader

from uav_ident_ros.bags.writing import write_file
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.offline.summary import Replayed
from uav_ident_ros.offline.tables import Words
from uav_ident_ros.report.sections import Section, sections
from uav_ident_ros.report.style import COLORS
from uav_ident_ros.report.timeline import Chart

EARLIEST_DATE_NS = 946_684_800_000_000_000
"""The year 2000, ns: earlier stamps count from the start of a computer and say no date."""

_NAMES = re.compile(r'(?<=")p\d{4,}(?=")')
"""Names that Bokeh makes up for its models, anew in every run."""


def write_report(path: Path, replayed: Replayed) -> None:
    """Write the report of a replay.

    Raises
    ------
    BagError
        If the bag cannot be read again, for its hash.
    BagWriteError
        If the file cannot be written.
    """
    summary, doubt = replayed.summary, replayed.doubt
    state = f" ({summary['reason']})" if summary["reason"] and not doubt else ""
    text = render(
        [*sections(replayed)],
        name=replayed.name,
        facts=_facts(summary),
        usable=not doubt,
        verdict=f"not usable: {doubt}" if doubt else "usable",
        state=f"State at the end: {summary['state']}{state}.",
        advice=[entry["text"] for entry in summary["advice"]],
        notes=summary["notes"],
    )
    write_file(path, text)


def render(sections: Sequence[Section], **content: Any) -> str:
    """Return a page with sections and their charts; `content` is what else it is to show."""
    loader = PackageLoader("uav_ident_ros.report")
    page = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    page.filters["sentence"] = _sentence
    page.tests["words"] = lambda heading: isinstance(heading, Words)
    drawn, names = _embed([chart for section in sections for chart in section.charts])
    return page.get_template("page.html").render(
        sections=sections,
        colors=COLORS,
        style=page.get_template("style.css").render(),
        library="\n".join(Resources(mode="inline", components=["bokeh"]).js_raw),
        script=page.get_template("charts.js").render(),
        drawn=drawn,
        names=names,
        **content,
    )


def _embed(charts: Iterable[Chart]) -> tuple[str, dict[str, str]]:
    """Return the charts as JSON, and the name of each in it; both are the same in every run."""
    document, roots = Document(), {chart.identity: chart.model for chart in charts}
    for model in roots.values():
        document.add_root(model)
    seen: dict[str, str] = {}

    def named(made_up: str) -> str:
        return seen.setdefault(made_up, f"m{len(seen)}")

    text = serialize_json(document.to_json(deferred=False))
    text = _NAMES.sub(lambda found: named(found.group()), text)
    return text.replace("</", "<\\/"), {name: named(model.id) for name, model in roots.items()}


def _facts(summary: Mapping[str, Any]) -> list[str]:
    first_ns, settings = summary["first_tick_ns"], summary["settings"]
    facts = [
        f"{(summary['last_tick_ns'] - first_ns) * NS:.0f} s of flight",
        f"{summary['ticks']} ticks",
        f"{settings['estimator']}, {settings['structure']}",
    ]
    if first_ns > EARLIEST_DATE_NS:
        facts.insert(0, f"{datetime.fromtimestamp(first_ns * NS, tz=UTC):%Y-%m-%d %H:%M} UTC")
    return facts


def _sentence(text: str) -> str:
    """Return a sentence: a capital at its beginning, a full stop at its end."""
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
