# SPDX-License-Identifier: Apache-2.0
"""What has been heard as one picture of `rich`: the same for a terminal and for a pipe.

The coefficients stand in columns, a row of the model each, side by side where the width allows:
on 80 columns and 24 lines the moment equations are in sight.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from uav_ident_ros.identification.linearisation import Mode
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import KINEMATIC_ROWS
from uav_ident_ros.monitor.heard import AXIS_OF, Coefficient, Heard

COLUMN_WIDTH = 26
"""Characters of a column: name, value, sigma, t-ratio, trend."""

GAP = 1
"""Characters between two columns, and two cells."""

CELL_WIDTHS = (5, 7, 5, 4)
"""Characters of name, value, sigma and t-ratio."""

LONGEST_NAME = 10
"""Characters of `alphadot/1`."""

AXES = 3
"""Columns that should fit side by side."""

AIRSPEED = "airspeed"
"""The state that is no angle."""

SPARKS = 10
"""Characters of the line of past values, where the terminal is wide enough for it."""

SHOWN_RATIO = 999.0
"""Largest t-ratio that is written out."""

WELL_KNOWN = SupervisionSettings().min_t_ratio
"""t-ratio from which a coefficient counts as known: the default of `supervision.min_t_ratio`."""

STATE_STYLES = {"learning": "cyan", "converged": "green", "fault": "bold red"}
OTHER_STATE = "yellow"

CONFIDENCE = {"none": "as set", "low": "estimated, not sure yet", "sure": "estimated, sure"}
"""What the node says of its delay, in words."""


@dataclass(frozen=True)
class Glyphs:
    """Characters that the terminal can show."""

    # up, down, level: Trends
    up: str = "↗"
    down: str = "↘"
    level: str = "→"
    sparks: str = "▁▂▃▄▅▆▇█"  # Levels of the line of past values, lowest first
    # usable, unusable: Verdict on a row
    usable: str = "✓"
    unusable: str = "✗"
    damping: str = "ζ"


ASCII = Glyphs("/", "\\", "-", "_.-~^", "+", "x", "z")
"""For terminals without UTF-8."""


def picture(heard: Heard, console: Console) -> RenderableType:
    """Return everything worth seeing, to be printed on `console`."""
    glyphs = ASCII if console.options.ascii_only else Glyphs()
    sparks = console.width >= AXES * (COLUMN_WIDTH + SPARKS + GAP) - GAP
    width = COLUMN_WIDTH + SPARKS if sparks else COLUMN_WIDTH
    rows = [_row(heard, row, glyphs, sparks) for row in heard.rows() if row not in KINEMATIC_ROWS]
    if set(KINEMATIC_ROWS) & set(heard.rows()):
        rows.append(_kinematics(heard))
    return Group(
        *_head(heard),
        "",
        _side_by_side(rows, width, console.width),
        *_inputs(heard),
        *_foot(heard, glyphs),
    )


def _side_by_side(parts: Sequence[RenderableType], width: int, whole: int) -> Table:
    """Return parts of a width beside one another, as many as go into the whole one."""
    count = max(1, min(AXES, (whole + GAP) // (width + GAP)))
    table = Table.grid(padding=(0, GAP, 0, 0))
    for _ in range(count):
        table.add_column(width=width, no_wrap=True)
    for first in range(0, len(parts), count):
        table.add_row(*parts[first : first + count])
    return table


# --- who and how ------------------------------------------------------------------------------


def _head(heard: Heard) -> Iterator[Text]:
    """Yield name, state, verdict and tick, then what is wrong or lacking."""
    state = heard.status.state
    tick = ("no tick yet", "yellow")
    if heard.tick is not None:
        tick = (f"tick {heard.tick:.2f} s", "")
        if not heard.fresh:
            tick = (f"last {tick[0]}, none since", "bold red")
    yield Text("  ").join(
        [
            Text(heard.node, "bold"),
            Text(state or "?", STATE_STYLES.get(state, OTHER_STATE)),
            _verdict(heard.usable),
            Text(*tick),
        ]
    )
    if heard.publishers > 1:
        yield Text(f"{heard.publishers} nodes publish under this name: they get mixed", "bold red")
    if heard.status.reason:
        yield Text(heard.status.reason)


def _verdict(usable: bool) -> Text:
    return Text("usable", "bold green") if usable else Text("not usable", "bold yellow")


# --- coefficients -----------------------------------------------------------------------------


def _row(heard: Heard, row: str, glyphs: Glyphs, sparks: bool) -> RenderableType:
    """Return a row of the model: its excitation, fit and coefficients."""
    excitation = heard.status.number(f"excitation {row} [0..1]")
    head, usable = Text(row, "bold"), heard.usable_row(row)
    if usable is not None:
        verdict = (glyphs.usable, "green") if usable else (glyphs.unusable, "yellow")
        head.append(f" {verdict[0]}", verdict[1])
    if excitation is not None:
        head.append(f"   excited {excitation:.2f}", "not bold dim")
    table = _grid(CELL_WIDTHS)
    table.add_column(no_wrap=True)
    for coefficient in heard.coefficients():
        if coefficient.row == row:
            table.add_row(*_cells(coefficient, glyphs, sparks))
    fit = [_fit(heard, row)] if row in AXIS_OF else []
    return Group(head, *fit, table)


def _grid(widths: Sequence[int]) -> Table:
    table = Table.grid(padding=(0, GAP, 0, 0))
    for cell, width in enumerate(widths):
        table.add_column(justify="right" if cell else "left", width=width, no_wrap=True)
    return table


def _kinematics(heard: Heard) -> Table:
    table = _grid((LONGEST_NAME, *CELL_WIDTHS[1:3]))
    table.add_row(Text("kinematics", "bold"))
    for coefficient in heard.coefficients():
        if coefficient.row in KINEMATIC_ROWS:
            value, sigma = _value(coefficient.value), _sigma(coefficient.sigma)
            table.add_row(coefficient.name, value, sigma)
    return table


def _fit(heard: Heard, row: str) -> Text:
    """Return the fit of a moment equation beside that of holding the rate."""
    fit, hold = heard.fit_of(row)
    if fit is None:
        return Text("no fit yet", "dim")
    better = fit > (0.0 if hold is None else hold)
    held = "" if hold is None else f"  hold {hold:.0f} %"
    return Text.assemble((f"fit {fit:.0f} %", "green" if better else "yellow"), (held, "dim"))


def _cells(coefficient: Coefficient, glyphs: Glyphs, sparks: bool) -> Iterator[Text]:
    """Yield name, value, standard deviation, t-ratio and trend of a coefficient."""
    ratio = coefficient.t_ratio
    style = "" if ratio is None or ratio >= WELL_KNOWN else "dim"
    shown = "" if ratio is None else ">999" if ratio > SHOWN_RATIO else f"{ratio:.0f}"
    name = coefficient.name.partition("/")[2]
    for text in (name, _value(coefficient.value), _sigma(coefficient.sigma), shown):
        yield Text(text, style)
    if coefficient.sigma > 0.0:
        trend = coefficient.trend
        glyph = (glyphs.level, glyphs.up, glyphs.down)[trend]
        past = f" {_spark_line(coefficient, glyphs.sparks)}" if sparks else ""
        yield Text(f"{glyph}{past}", "cyan" if trend else "dim")


def _value(value: float) -> str:
    """Return up to 7 characters."""
    size = abs(value)
    return f"{value:+.{3 if size < 99.9995 else 2}f}" if size < 999.995 else f"{value:+.0e}"


def _sigma(sigma: float) -> str:
    """Return up to 5 characters."""
    if sigma == 0.0:
        return "fixed"
    if not math.isfinite(sigma):
        return "inf"
    if sigma < 5e-4 or sigma >= 999.95:
        return f"{sigma:.0e}"
    return f"{sigma:.3f}" if sigma < 9.9995 else f"{sigma:.1f}"


def _spark_line(coefficient: Coefficient, levels: str) -> str:
    """Return past values between the least and the largest, at least two sigma apart."""
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


def _inputs(heard: Heard) -> Iterator[RenderableType]:
    """Yield what arrives on every input, and what was dropped for which reason."""
    for stream, values in heard.status.inputs().items():
        age, dropped = values.get("age [s]", "?"), values.get("dropped", "0")
        yield Text.assemble(
            f"{stream:<10}",
            (f"{values['topic']:<20}", "bold"),
            f"  {values.get('rate [Hz]', '?')} Hz",
            f"  age {age} s" if age[:1].isdigit() else f"  {age}",
            (f"  dropped {dropped}", "" if dropped == "0" else "yellow"),
            no_wrap=True,
        )
        reasons = ", ".join(
            f"{label.removeprefix('dropped: ')} {count}"
            for label, count in values.items()
            if label.startswith("dropped: ")
        )
        if reasons:
            yield Padding(Text(f"dropped: {reasons}", "yellow", no_wrap=True), (0, 0, 0, 10))


def _state(name: str, value: float) -> str:
    if name == AIRSPEED:
        return f"{name} {value:.1f} m/s"
    return f"{name} {math.degrees(value):+.1f}°"


def _mode(mode: Mode, glyphs: Glyphs) -> str:
    """Return a mode: natural frequency, rad/s, and damping ratio, or time constant."""
    if math.isfinite(mode.frequency):
        damping = f"{mode.damping:.2f}".replace("0.", ".", 1)
        return f"{mode.name} {mode.frequency:.2g} {glyphs.damping}{damping}"
    return f"{mode.name} {mode.time_constant:.2g} s"


def _foot(heard: Heard, glyphs: Glyphs) -> Iterator[Text]:
    """Yield the state of the model, its modes, the delay, the ticks and what is collinear."""
    status = heard.status
    if heard.states:
        shown = ", ".join(_state(name, value) for name, value in heard.states.items())
        yield Text.assemble(f"{'state':<10}", shown, no_wrap=True)
    if modes := heard.modes():
        shown = ", ".join(_mode(mode, glyphs) for mode in modes)
        yield Text(f"{'modes':<10}{shown}", no_wrap=True)
    yield from _excitation(status.group("excite"))
    delay = status.number("delay [s]")
    ticks = status.group("ticks")
    line = Text(no_wrap=True)
    if delay is not None:
        confidence = status.values.get("delay confidence", "")
        line.append(f"{'delay':<10}").append(f"{1e3 * delay:.0f} ms", "bold")
        line.append(f"  {CONFIDENCE.get(confidence, confidence)}  ")
    if "count" in ticks:
        cost = ticks.get("update time p99 [ms]")
        line.append(f"{'ticks':<10}{ticks['count']}{f'  update {cost} ms (p99)' if cost else ''}")
    if line:
        yield line
    apart = status.values.get("not told apart", "nothing")
    if apart != "nothing":
        yield Text.assemble(("not told apart: ", "yellow"), apart, no_wrap=True)


def _excitation(values: Mapping[str, str]) -> Iterator[Text]:
    """Yield how a run of excitation goes, or how the last one ended; nothing before the first."""
    ended = values.get("last run", "none yet")
    if "remaining [s]" in values:
        left = values.get("until known [s]", "?")
        known = f"known in {left} s" if left.isdigit() else "not yet told when known"
        yield Text.assemble(
            f"{'excite':<10}",
            (values.get("state", "?"), "bold magenta"),
            f"  {values.get('elapsed [s]', '?')} s, at most {values['remaining [s]']} s left",
            f"  {known}: {values.get('not known yet', '?')}",
            no_wrap=True,
        )
    elif ended != "none yet":
        style = "yellow" if ended.startswith("aborted") else ""
        yield Text.assemble(f"{'excite':<10}", (ended, style), no_wrap=True)
