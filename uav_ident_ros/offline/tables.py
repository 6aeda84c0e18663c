# SPDX-License-Identifier: Apache-2.0
"""Tables of results: declared once, printed in columns and shown on the page."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from uav_ident_ros.commandline import LINE_LENGTH
from uav_ident_ros.files.meanings import MEANINGS
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.structure import RATES

KNOWN_FROM = 3.0
"""t-ratio from which a coefficient counts as known."""

NONE = "-"
"""Text of a missing number."""

GAP = "  "
"""Space between two columns."""


@dataclass(frozen=True)
class Number:
    """A number as a cell, with its standard deviation if it has one."""

    value: float | None
    style: str = ".4g"
    sigma: float | None = None
    shaded: bool = False  # Whether to shade the cell by its magnitude, as for correlations

    def __str__(self) -> str:
        if self.value is None or not math.isfinite(self.value):
            return NONE
        text = f"{self.value:{self.style}}"
        return text if self.sigma is None else f"{text} +- {self.sigma:.2g}"

    @property
    def share(self) -> float:
        """Magnitude of the number; 0 if it is missing."""
        return abs(self.value) if self.value is not None and math.isfinite(self.value) else 0.0

    def __html__(self) -> str:
        """Return the number as HTML, with its exact value in ``data`` elements."""
        exact = zip(
            (self.value, self.sigma), str(self).replace("-", "−").split(" +− "), strict=False
        )
        tags = (f'<data value="{value}">{text}</data>' for value, text in exact)
        return "–" if str(self) == NONE else " ± ".join(tags)


class Words(str):
    """A cell of text, or the heading of such cells, aligned left."""


Cell = str | Number


@dataclass(frozen=True)
class Row:
    """A row of a table: its heading, its cells, and whether it is printed pale."""

    name: str
    cells: Sequence[Cell]
    weak: bool = False


@dataclass(frozen=True)
class Table:
    """A table; with a text in `folded`, the page shows the text, which unfolds the table."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Row]
    folded: str = ""


def columns(table: Table) -> Iterator[str]:
    """Yield the lines of a table: headings of rows and `Words` aligned left, the rest right."""
    if table.caption:
        yield table.caption
    lines: list[Sequence[Cell]] = [table.head, *([row.name, *row.cells] for row in table.rows)]
    widths = [max(len(str(cell)) for cell in column) for column in zip(*lines, strict=True)]
    for line in lines:
        cells = [
            f"{cell!s:{'<' if k == 0 or isinstance(cell, Words) else '>'}{width}}"
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        yield GAP.join(cells).rstrip()


# --- of summary.json ----------------------------------------------------------------------------


def coefficients_table(
    summary: Mapping[str, Any], truth: Mapping[str, float] | None = None
) -> Table:
    """Return value, sigma, t-ratio and meaning of all coefficients, and known true values."""
    rows = []
    for name, entry in summary["coefficients"].items():
        value, sigma = entry["value"], entry["sigma"]
        ratio = abs(value) / sigma if sigma and value is not None else None
        cells: list[Cell] = [Number(value)]
        if truth:
            cells.append(Number(truth.get(name)))
        cells.append("fixed" if sigma == 0.0 else Number(sigma, ".2g"))
        cells += [Number(ratio, ".1f"), Words(MEANINGS.get(name, ""))]
        rows.append(Row(name, cells, ratio is not None and ratio < KNOWN_FROM))
    true_head = ["true"] if truth else []
    head = ["coefficient", "value", *true_head, "sigma", "t-ratio", Words("meaning")]
    return Table("Coefficients, SI units, body axes FRD", head, rows)


FIT_CAPTIONS = {
    "last_40_percent": "Last 40 % of the flight",
    "after_30_s": "After 30 s",
}
"""Captions of the selections of windows."""


def fit_tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """Yield the fit of the predictions for each selection of windows."""
    for windows, fit in summary["prediction_fit"].items():
        rows = []
        for ahead, found in fit["free"].items():
            rows.append(fit_row(f"free prediction, {ahead}", found["model"].values()))
            rows.append(fit_row(f"holding the rates for {ahead}", found["hold"].values()))
        measured = fit["model_with_measured_forces"].values()
        if any(value is not None for value in measured):
            rows.append(fit_row("with measured forces, 1 s", measured))
        # of the shortest horizon: the flight covers fewer windows of the others
        counted = f"{fit['windows']} windows of {next(iter(fit['free']))}"
        count = counted if fit["windows"] else "no window to score"
        yield Table(f"{FIT_CAPTIONS[windows]}, {count}", ("fit [%]", *RATES), rows)


def fit_row(name: str, values: Iterable[float | None]) -> Row:
    """Return a row of percentages."""
    return Row(name, [Number(value, ".1f") for value in values])


def modes_table(summary: Mapping[str, Any]) -> Table:
    """Return frequency and damping, or time constant, of all modes, with standard deviations."""
    quantities = ("frequency", "damping", "time_constant")
    rows = [
        Row(mode["name"], [Number(mode[q], ".3g", mode[f"{q}_sigma"]) for q in quantities])
        for mode in summary["modes"]
    ]
    head = ("mode", "frequency [rad/s]", "damping ratio", "time constant [s]")
    return Table("Modes in level flight", head, rows)


def write_table(summary: Mapping[str, Any]) -> str:
    """Return the results of a replay, as in summary.json, as text."""
    tables = [coefficients_table(summary), *fit_tables(summary)]
    tables += [modes_table(summary)] if summary["modes"] else []
    parts = [_heading(summary), *map(columns, tables), _verdict(summary)]
    return "\n\n".join("\n".join(lines) for lines in parts)


def duration_of(summary: Mapping[str, Any]) -> float:
    """Return the length of a flight, s, by its ticks: its clock may have been set."""
    return float((summary["ticks"] - 1) / summary["settings"]["update_rate"])


def told(summary: Mapping[str, Any]) -> tuple[str, list[str]]:
    """Return the doubt and the advice; a piece that begins with a reason of the doubt replaces it.

    The reasons are separated by semicolons, which a reason may have, too.
    """
    doubt, advice = summary["doubt"], []
    parts = doubt.split("; ") if doubt else []
    reasons = ["; ".join(parts[i:j]) for i, j in combinations(range(len(parts) + 1), 2)]
    for text in (entry["text"] for entry in summary["advice"]):
        if repeated := max(filter(text.startswith, reasons), key=len, default=""):
            doubt = doubt.replace(repeated, text)
        else:
            advice.append(text)
    return doubt, advice


def _heading(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield the flight, the settings, the inputs and the delay."""
    settings, reason = summary["settings"], summary["reason"]
    reason = "" if reason == summary["doubt"] else reason  # the verdict has it
    yield f"{summary['bag']}: {duration_of(summary):.1f} s, {summary['ticks']} ticks"
    yield f"structure {settings['structure']}, estimator {settings['estimator']}"
    yield f"state at the end: {summary['state']}{f' ({reason})' if reason else ''}"
    for stream, entry in summary["inputs"].items():
        dropped = "".join(f", {count} {why}" for why, count in entry["dropped"].items())
        messages = f"{entry['received']} messages{dropped}"
        yield f"{stream}: {entry['topic']} ({entry['type']}), {messages}"
    if settings["actuators.estimate_delay"]:
        if summary["delay_confidence"] == "sure":
            sigma = f"{summary['delay_sigma']:.2g}"
            yield f"estimated delay of the inputs: {summary['delay']:.3f} s, sigma {sigma}"
        else:
            yield f"delay of the inputs: {summary['delay']:.3f} s in use; none was found for sure"
    if lag := summary["servo_lag"]:
        yield (
            f"servo lag by the injected signal: {lag['value']:.3f} s, sigma {lag['sigma']:.2g}, "
            f"with a delay of {max(lag['delay'], 0.0):.3f} s; {lag['in_use']:.3f} s in use"
        )
    if settings["airspeed.type"]:
        reference = settings["airspeed.reference"]
        yield f"coefficients at the reference airspeed, {reference:g} m/s"


def _verdict(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield the verdict, the notes on the bag, and the advice."""
    rows = summary["usable_rows"].items()
    each = ", ".join(f"{row} {'usable' if usable else 'not'}" for row, usable in rows)
    doubt, advice = told(summary)
    yield _filled("verdict", f"not usable ({each}): {doubt}" if doubt else "usable")
    if summary["judged_ns"] < summary["last_tick_ns"]:
        seconds = (summary["judged_ns"] - summary["first_tick_ns"]) * NS
        yield f"as of {seconds:.1f} s: nothing was learned after"
    shares = summary["usable_share"].items()
    if doubt and any(share for _, share in shares):
        flown = ", ".join(f"{row} {100.0 * share:.0f} %" for row, share in shares)
        yield f"usable in the course of the flight: {flown} of the ticks"
    for word, texts in (("note", summary["notes"]), ("advice", advice)):
        yield from (_filled(word, text) for text in texts)


def _filled(word: str, text: str) -> str:
    """Return a remark after its word, in lines."""
    return textwrap.fill(f"{word}: {text}", LINE_LENGTH, subsequent_indent="  ")
