# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one file that any browser opens, from a memory stick, without a network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.offline.run import OfflineRun
from uav_ident_ros.report.flight import Flight, collect
from uav_ident_ros.report.markup import element
from uav_ident_ros.report.sections import sections
from uav_ident_ros.report.style import style_sheet

if TYPE_CHECKING:  # replay imports the report
    from uav_ident_ros.replay.evidence import Evidence

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
    parts = list(sections(flight, bag, summary, evidence))
    links = [
        element("li", element("a", str(part[0].text), href=f"#{part.get('id')}")) for part in parts
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
            element("main", *parts),
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
    return element(
        "header",
        element("h1", flight.name),
        element("p", " · ".join(facts), class_="lead"),
        _verdict(summary),
        nav,
    )


def _verdict(summary: Mapping[str, Any]) -> Element:
    reason = summary["reason"]
    if summary["usable"]:
        words, why = "Usable", ": a controller could have acted on the last estimate"
        state = f"{summary['state']} ({reason})" if reason else summary["state"]
    else:
        words, why = "Not usable", f": {reason}" if reason else ""
        state = summary["state"]
    return element(
        "div",
        element("p", element("strong", words), why),
        element("p", f"State at the end: {state}.", class_="note"),
        *_advice(summary),
        class_="verdict usable" if summary["usable"] else "verdict",
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
