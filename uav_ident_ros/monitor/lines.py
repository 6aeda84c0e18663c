# SPDX-License-Identifier: Apache-2.0
"""What has been heard as lines of text with styles: the same for a terminal and for a pipe.

The coefficients stand as three columns, a row of A each, side by side where the width allows:
on 80 columns and 24 lines everything is in sight.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from uav_ident_ros.identification.structure import ROWS
from uav_ident_ros.monitor.heard import Coefficient, Heard

Span = tuple[str, str]
"""Text and its style; the styles are words that `rich` knows."""

Line = list[Span]

COLUMN_WIDTH = 25
"""Characters of a column: name, value, sigma, t-ratio, trend."""

GAP = 2
"""Characters between two columns."""

SPARKS = 10
"""Characters of the line of past values, where the terminal is wide enough for it."""

SHOWN_RATIO = 999.0
"""Largest t-ratio that is written out."""

WELL_KNOWN = 3.0
"""t-ratio from which a coefficient counts as known: the default of `supervision.min_t_ratio`."""

_STATE_STYLES = {"learning": "cyan", "converged": "green", "fault": "bold red"}
_OTHER_STATE = "yellow"


@dataclass(frozen=True)
class Glyphs:
    """Characters that the terminal can show.

    Parameters
    ----------
    up, down, level : str
        Trends.
    sparks : str
        Levels of the line of past values, lowest first.
    """

    up: str = "↗"
    down: str = "↘"
    level: str = "→"
    sparks: str = "▁▂▃▄▅▆▇█"


ASCII = Glyphs("/", "\\", "-", "_.-~^")
"""For terminals without UTF-8."""


def glyphs_for(encoding: str | None) -> Glyphs:
    """Return the glyphs that an output of this encoding can carry."""
    best = Glyphs()
    try:
        (best.up + best.down + best.level + best.sparks).encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return ASCII
    return best


def plain(line: Line) -> str:
    """Return a line as text."""
    return "".join(text for text, _ in line).rstrip()


def lines(heard: Heard, width: int, glyphs: Glyphs | None = None) -> list[Line]:
    """Return everything worth seeing.

    Parameters
    ----------
    heard : Heard
        What has been heard.
    width : int
        Characters on a line.
    glyphs : Glyphs, optional
        Characters for the trends; those of Unicode if left out.
    """
    body = [
        *_head(heard, width),
        [],
        *_columns(heard, width, glyphs or Glyphs()),
        [],
        *_inputs(heard),
        *_foot(heard),
    ]
    return [_cut(line, width) for line in body]


def _cut(line: Line, width: int) -> Line:
    """Cut a line at `width`."""
    cut: Line = []
    left = width
    for text, style in line:
        if left > 0:
            cut.append((text[:left], style))
        left -= len(text)
    return cut


# --- who and how ------------------------------------------------------------------------------


def _head(heard: Heard, width: int) -> Iterator[Line]:
    state = heard.status.state
    verdict = ("usable", "bold green") if heard.usable else ("not usable", "bold yellow")
    tick: Span = ("no tick yet", "yellow")
    if heard.tick is not None:
        tick = (f"tick {heard.tick:.2f} s", "")
        if not heard.fresh:
            tick = (f"last {tick[0]}, none since", "bold red")
    yield [
        (heard.node, "bold"),
        ("  ", ""),
        (state or "?", _STATE_STYLES.get(state, _OTHER_STATE)),
        ("  ", ""),
        verdict,
        ("  ", ""),
        tick,
    ]
    if heard.publishers > 1:
        yield [(f"{heard.publishers} nodes publish under this name: they get mixed", "bold red")]
    for part in textwrap.wrap(heard.status.reason, width):
        yield [(part, "")]


# --- coefficients -----------------------------------------------------------------------------


def _columns(heard: Heard, width: int, glyphs: Glyphs) -> Iterator[Line]:
    """Yield a column for each row of A, as many side by side as the width allows."""
    wide = COLUMN_WIDTH + SPARKS
    sparks = len(ROWS) * (wide + GAP) - GAP <= width
    column_width = wide if sparks else COLUMN_WIDTH
    columns = [
        [
            *_column_head(heard, axis, row),
            *(
                _coefficient_line(coefficient, glyphs, sparks)
                for coefficient in heard.coefficients()
                if coefficient.name.startswith(f"{row}/")
            ),
        ]
        for axis, row in enumerate(ROWS)
    ]
    side_by_side = max(1, (width + GAP) // (column_width + GAP))
    for first in range(0, len(columns), side_by_side):
        if first:
            yield []
        yield from _beside(columns[first : first + side_by_side], column_width)


def _beside(columns: Sequence[Sequence[Line]], width: int) -> Iterator[Line]:
    """Yield the lines of columns side by side."""
    for row in zip_longest(*columns, fillvalue=()):
        line: Line = []
        for part in row:
            used = sum(len(text) for text, _ in part)
            line += [*part, (" " * (width - used + GAP), "")]
        yield line


def _column_head(heard: Heard, axis: int, row: str) -> Iterator[Line]:
    """Yield name, fit beside that of holding the rate, and excitation of a row."""
    excitation = heard.status.number(f"excitation {row} [0..1]")
    excited = "" if excitation is None else f"   excited {excitation:.2f}"
    yield [(row, "bold"), (excited, "dim")]
    fit, hold = heard.fit, heard.status.per_axis("hold")
    if fit is None:
        yield [("no fit yet", "dim")]
    else:
        better = fit[axis] > (0.0 if hold is None else hold[axis])
        held = "" if hold is None else f"  hold {_percent(hold[axis])}"
        yield [(f"fit {_percent(fit[axis])}", "green" if better else "yellow"), (held, "dim")]
    yield [(f"{'':<3} {'value':>8} {'sigma':>5} {'t':>4}", "dim")]


def _percent(value: float) -> str:
    return f"{value:.0f} %"


def _coefficient_line(coefficient: Coefficient, glyphs: Glyphs, sparks: bool) -> Line:
    name = coefficient.name.partition("/")[2]
    ratio = coefficient.t_ratio
    known = ratio is None or ratio >= WELL_KNOWN
    shown = "" if ratio is None else ">999" if ratio > SHOWN_RATIO else f"{ratio:.0f}"
    text = f"{name:<3} {_value(coefficient.value):>8} {_sigma(coefficient.sigma):>5} {shown:>4}"
    line: Line = [(text, "" if known else "dim")]
    if coefficient.sigma > 0.0:
        trend = coefficient.trend
        glyph = (glyphs.level, glyphs.up, glyphs.down)[trend]
        line.append((f" {glyph}", "cyan" if trend else "dim"))
        if sparks:
            line.append((f" {_spark_line(coefficient, glyphs.sparks)}", "cyan" if trend else "dim"))
    return line


def _value(value: float) -> str:
    """Up to 8 characters."""
    return f"{value:+.3f}" if abs(value) < 1e3 else f"{value:+.1e}"


def _sigma(sigma: float) -> str:
    """Up to 5 characters."""
    if sigma == 0.0:
        return "fixed"
    if not math.isfinite(sigma):
        return "inf"
    if sigma < 5e-4 or sigma >= 999.95:
        return f"{sigma:.0e}"
    return f"{sigma:.3f}" if sigma < 9.9995 else f"{sigma:.1f}"


def _spark_line(coefficient: Coefficient, levels: str) -> str:
    """Past values between the least and the largest, at least two standard deviations apart."""
    past = coefficient.past
    if not math.isfinite(coefficient.sigma):
        return ""
    chosen = [past[round(i * (len(past) - 1) / (SPARKS - 2))] for i in range(SPARKS - 1)]
    low, high = min(chosen), max(chosen)
    span = max(high - low, 2.0 * coefficient.sigma)
    bottom = 0.5 * (low + high - span)
    top = len(levels) - 1
    return "".join(levels[min(top, int((value - bottom) / span * top + 0.5))] for value in chosen)


# --- inputs -----------------------------------------------------------------------------------


def _inputs(heard: Heard) -> Iterator[Line]:
    for stream, values in heard.status.inputs().items():
        dropped = values.get("dropped", "0")
        reasons = ", ".join(
            f"{label.removeprefix('dropped: ')} {count}"
            for label, count in values.items()
            if label.startswith("dropped: ")
        )
        age = values.get("age [s]", "?")
        yield [
            (f"{stream:<10}", ""),
            (f"{values['topic']:<20}", "bold"),
            (f"  {values.get('rate [Hz]', '?')} Hz", ""),
            (f"  age {age} s" if age[:1].isdigit() else f"  {age}", ""),
            (f"  dropped {dropped}", "" if dropped == "0" else "yellow"),
        ]
        if reasons:
            yield [(f"{'':<10}dropped: {reasons}", "yellow")]


def _foot(heard: Heard) -> Iterator[Line]:
    status = heard.status
    delay = status.number("delay [s]")
    if delay is not None:
        sure = {"none": "as set", "low": "estimated, not sure yet", "sure": "estimated, sure"}
        confidence = status.values.get("delay confidence", "")
        yield [(f"{'delay':<10}", ""), (f"{1e3 * delay:.0f} ms", "bold"),
               (f"  {sure.get(confidence, confidence)}", "")]  # fmt: skip
    ticks = status.group("ticks")
    if "count" in ticks:
        cost = ticks.get("update time p99 [ms]")
        yield [
            (f"{'ticks':<10}{ticks['count']}", ""),
            (f"  update {cost} ms (p99)" if cost else "", ""),
        ]
    apart = status.values.get("not told apart", "nothing")
    if apart != "nothing":
        yield [("not told apart: ", "yellow"), (apart, "")]
