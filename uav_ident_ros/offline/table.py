# SPDX-License-Identifier: Apache-2.0
"""The results of a replay in words and columns: table.txt, and what is printed."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from uav_ident_ros.identification.samples import NS
from uav_ident_ros.offline.tables import coefficients_table, columns, fit_tables, modes_table

WIDTH = 100
"""Columns of the longest line."""


def write_table(
    summary: Mapping[str, Any],  # Content of summary.json
) -> str:
    """Return the results of a replay in words and columns."""
    tables = [coefficients_table(summary), *fit_tables(summary)]
    tables += [modes_table(summary)] if summary["modes"] else []
    parts = [_heading(summary), *map(columns, tables), _verdict(summary)]
    return "\n\n".join("\n".join(lines) for lines in parts)


def _heading(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield what was replayed, and how."""
    settings, reason = summary["settings"], summary["reason"]
    seconds = (summary["last_tick_ns"] - summary["first_tick_ns"]) * NS
    yield f"{summary['bag']}: {seconds:.1f} s, {summary['ticks']} ticks"
    yield f"structure {settings['structure']}, estimator {settings['estimator']}"
    yield f"state at the end: {summary['state']}{f' ({reason})' if reason else ''}"
    for stream, entry in summary["inputs"].items():
        dropped = "".join(f", {count} {why}" for why, count in entry["dropped"].items())
        messages = f"{entry['received']} messages{dropped}"
        yield f"{stream}: {entry['topic']} ({entry['type']}), {messages}"
    if settings["actuators.estimate_delay"]:
        sigma = summary["delay_sigma"]
        known = "unknown" if sigma is None else f"{sigma:.2g}"
        yield f"estimated delay of the inputs: {summary['delay']:.3f} s, sigma {known}"
    if settings["airspeed.type"]:
        reference = settings["airspeed.reference"]
        yield f"coefficients at the reference airspeed, {reference:g} m/s"


def _verdict(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield whether the model is usable, what the bag is like, and what to do."""
    rows = summary["usable_rows"].items()
    each = ", ".join(f"{row} {'usable' if usable else 'not'}" for row, usable in rows)
    doubt = summary["doubt"]
    yield f"verdict: not usable ({each}): {doubt}" if doubt else "verdict: usable"
    said = [("note", text) for text in summary["notes"]]
    said += [("advice", advice["text"]) for advice in summary["advice"]]
    for word, text in said:
        yield textwrap.fill(f"{word}: {text}", WIDTH, subsequent_indent="  ")
