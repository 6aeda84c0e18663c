# SPDX-License-Identifier: Apache-2.0
"""The view of the monitor, drawn with rich.

Each row of the model has a column of coefficients. The columns are side by side if the width
allows; a terminal of 80 by 24 characters shows all moment equations.
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from uav_ident_ros.identification.linearisation import Mode
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import KINEMATIC_ROWS, ROWS
from uav_ident_ros.messages.published import STATE_FIELDS
from uav_ident_ros.messages.types import NS_PER_S
from uav_ident_ros.monitor.watched_node import Coefficient, WatchedNode

COLUMN_WIDTH = 26
"""Characters of a column: name, value, sigma, t-ratio, trend."""

COLUMN_GAP = 1
"""Characters between two columns."""

AXIS_COLUMNS = 3
"""Number of columns side by side, if the terminal is wide enough."""

SPARKS = 10
"""Characters of the line of past values, where the terminal is wide enough for it."""

SHOWN_RATIO = 999.0
"""Largest t-ratio shown as a number."""

WELL_KNOWN = SupervisionSettings().min_t_ratio
"""t-ratio from which a coefficient counts as known: the default of `supervision.min_t_ratio`."""

STATE_STYLES = {"learning": "cyan", "converged": "green", "fault": "bold red"}
OTHER_STATE = "yellow"

CONFIDENCE = {"none": "as set", "low": "estimated, not sure yet", "sure": "estimated, sure"}
"""Text for each confidence of the delay."""


@dataclass(frozen=True)
class Glyphs:
    """Characters that the terminal can show."""

    trends: str = "→↗↘"  # By `Coefficient.trend`: level, up, down
    sparks: str = "▁▂▃▄▅▆▇█"  # Levels of the line of past values, lowest first; none, no line
    verdicts: str = "✗✓"  # On a row: not usable, usable
    damping: str = "ζ"
    degrees: str = "°"


ASCII = Glyphs("-/\\", "_.-~^", "x+", "z", " deg")
"""For terminals without UTF-8."""


class View:
    """Shows a watched node: on the whole terminal, or in plain lines without one."""

    def __init__(
        self,
        plain: bool = False,  # Plain lines on a terminal too
    ) -> None:
        self.period = 1.0  # Seconds between two pictures
        self._screen: Live | None = None
        if plain or not sys.stdout.isatty() or Console().is_dumb_terminal:
            self._console = Console(force_terminal=False, color_system=None, highlight=False)
        else:
            self._console, self.period = Console(), 0.5
            self._screen = Live(
                console=self._console, screen=True, auto_refresh=False, vertical_overflow="crop"
            )
            self._screen.start()

    def show(self, watched: WatchedNode) -> None:
        """Show the newest values, in the present size of the terminal, or in a block."""
        shown = picture(watched, self._console)
        if self._screen is not None:
            self._screen.update(shown, refresh=True)
            return
        with self._console.capture() as block:  # rich itself would exit on a closed pipe
            self._console.print(shown)
        print(block.get(), flush=True)  # an empty line ends a block

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._screen is not None:
            self._screen.stop()


def picture(watched: WatchedNode, console: Console) -> RenderableType:
    """Return the whole view, for the size of `console`."""
    glyphs = ASCII if console.options.ascii_only else Glyphs()
    width = COLUMN_WIDTH + SPARKS
    if console.width < AXIS_COLUMNS * (width + COLUMN_GAP) - COLUMN_GAP:
        width, glyphs = COLUMN_WIDTH, replace(glyphs, sparks="")
    rows = watched.rows()
    angles = [c for row in KINEMATIC_ROWS for c in rows.pop(row, ())]
    parts = [_row(watched, row, found, glyphs) for row, found in rows.items()]
    parts += [_kinematics(angles)] if angles else []
    count = max(1, min(AXIS_COLUMNS, (console.width + COLUMN_GAP) // (width + COLUMN_GAP)))
    table = Table.grid(padding=(0, COLUMN_GAP, 0, 0))
    for _ in range(count):
        table.add_column(width=width, no_wrap=True, overflow="crop")
    for first in range(0, len(parts), count):
        table.add_row(*parts[first : first + count])
    return Group(*_head(watched), "", table, *_inputs(watched), *_foot(watched, glyphs))


# --- node and state ---------------------------------------------------------------------------


def _head(watched: WatchedNode) -> Iterator[Text]:
    """Yield name, state, verdict and tick, then the problems."""
    state, tick = watched.state, Text("no tick yet", "yellow")
    if watched.newest is not None:
        tick = Text(f"tick {watched.newest.t_ns / NS_PER_S:.2f} s")
        if not watched.fresh:
            tick = Text(f"last {tick}, none since", "bold red")
    verdict = ("usable", "bold green") if watched.usable else ("not usable", "bold yellow")
    shown = state or "?", STATE_STYLES.get(state, OTHER_STATE)
    yield Text.assemble((watched.node, "bold"), "  ", shown, "  ", verdict, "  ", tick)
    if watched.publishers > 1:
        mixed = f"{watched.publishers} nodes publish under this name: they get mixed"
        yield Text(mixed, "bold red")
    if watched.reason:
        yield Text(watched.reason)


# --- coefficients -----------------------------------------------------------------------------


def _row(watched: WatchedNode, row: str, found: Sequence[Coefficient], glyphs: Glyphs) -> Text:
    """Return a row of the model: its excitation, fit and coefficients."""
    lines = [Text(row, "bold")]
    if row in ROWS:
        k = ROWS.index(row)
        if watched.newest is not None:
            usable = watched.newest.usable_rows[k] and watched.fresh
            lines[0].append(f" {glyphs.verdicts[usable]}", "green" if usable else "yellow")
        lines.append(_fit(watched, k))
    excitation = watched.number(f"excitation {row} [0..1]")
    if excitation is not None:
        lines[0].append(f"   excited {excitation:.2f}", "not bold dim")
    lines += (_coefficient(c, glyphs) for c in found)
    return Text("\n").join(lines)


def _kinematics(coefficients: Sequence[Coefficient]) -> Text:
    lines = (f"{c.name:<10} {_value(c.value):>7} {_sigma(c.sigma):>5}" for c in coefficients)
    return Text.assemble(("kinematics", "bold"), *(f"\n{line}" for line in lines))


def _fit(watched: WatchedNode, row: int) -> Text:
    """Return the running fit of a moment equation beside that of holding the rate, percent."""
    fits = None if watched.newest is None else watched.newest.fit
    hold = watched.number(f"hold {'pqr'[row]} [%]")
    if fits is None or not fits.any():
        return Text("no fit yet", "dim")
    fit = fits[row]
    better = fit > (0.0 if hold is None else hold)
    held = "" if hold is None else f"  hold {hold:.0f} %"
    return Text.assemble((f"fit {fit:.0f} %", "green" if better else "yellow"), (held, "dim"))


def _coefficient(coefficient: Coefficient, glyphs: Glyphs) -> Text:
    """Return name, value, standard deviation, t-ratio and trend of a coefficient."""
    ratio, trend = coefficient.t_ratio, coefficient.trend
    style = "" if ratio is None or ratio >= WELL_KNOWN else "dim"
    shown = "" if ratio is None else ">999" if ratio > SHOWN_RATIO else f"{ratio:.0f}"
    name = coefficient.name.partition("/")[2]
    value, sigma = _value(coefficient.value), _sigma(coefficient.sigma)
    line = Text.assemble((f"{name:<5} {value:>7} {sigma:>5} {shown:>4}", style))
    if coefficient.sigma > 0.0:
        past = f" {_spark_line(coefficient, glyphs.sparks)}" if glyphs.sparks else ""
        line.append(f" {glyphs.trends[trend]}{past}", "cyan" if trend else "dim")
    return line


def _value(value: float) -> str:
    """Return a value in up to 7 characters."""
    size = abs(value)
    return f"{value:+.{3 if size < 99.9995 else 2}f}" if size < 999.995 else f"{value:+.0e}"


def _sigma(sigma: float) -> str:
    """Return a standard deviation in up to 5 characters."""
    if sigma == 0.0:
        return "fixed"
    if not math.isfinite(sigma):
        return "inf"
    if sigma < 5e-4 or sigma >= 999.95:
        return f"{sigma:.0e}"
    return f"{sigma:.3f}" if sigma < 9.9995 else f"{sigma:.1f}"


def _spark_line(coefficient: Coefficient, levels: str) -> str:
    """Return a line of past values; its range is at least two sigma."""
    past = coefficient.past
    if not math.isfinite(coefficient.sigma):
        return ""
    chosen = [past[round(i * (len(past) - 1) / (SPARKS - 2))] for i in range(SPARKS - 1)]
    low, high = min(chosen), max(chosen)
    span = max(high - low, 2.0 * coefficient.sigma)
    bottom = 0.5 * (low + high - span)
    top = len(levels) - 1
    return "".join(levels[min(top, int((value - bottom) / span * top + 0.5))] for value in chosen)


# --- inputs and the rest ----------------------------------------------------------------------


def _line(label: str, *parts: str | tuple[str, str]) -> Text:
    return Text.assemble(f"{label:<10}", *parts, no_wrap=True)


def _inputs(watched: WatchedNode) -> Iterator[Text]:
    """Yield rate, age and drops of every input, with the reasons of the drops."""
    values = watched.values
    for stream in (key.removesuffix(": topic") for key in values if key.endswith(": topic")):
        age, dropped = values[f"{stream}: age [s]"], values[f"{stream}: dropped"]
        yield _line(
            stream,
            (f"{values[f'{stream}: topic']:<20}", "bold"),
            f"  {values[f'{stream}: rate [Hz]']} Hz",
            f"  age {age} s" if age[:1].isdigit() else f"  {age}",
            (f"  dropped {dropped}", "" if dropped == "0" else "yellow"),
        )
        start = f"{stream}: dropped: "
        reasons = [f"{k.removeprefix(start)} {n}" for k, n in values.items() if k.startswith(start)]
        if reasons:
            yield _line("", (f"dropped: {', '.join(reasons)}", "yellow"))


def _mode(mode: Mode, glyphs: Glyphs) -> str:
    """Return a mode: natural frequency, rad/s, and damping ratio, or time constant."""
    if math.isfinite(mode.frequency):
        damping = f"{mode.damping:.2f}".replace("0.", ".", 1)
        return f"{mode.name} {mode.frequency:.2g} {glyphs.damping}{damping}"
    return f"{mode.name} {mode.time_constant:.2g} s"


def _foot(watched: WatchedNode, glyphs: Glyphs) -> Iterator[Text]:
    """Yield the state of the model, its modes, the delay, the ticks and what is collinear."""
    values, flow = watched.values, watched.newest and watched.newest.flow
    if flow:
        angles = (
            f"{name} {math.degrees(getattr(flow, name)):+.1f}{glyphs.degrees}, "
            for name in STATE_FIELDS[:-1]
        )
        yield _line("state", *angles, f"airspeed {flow.airspeed:.1f} m/s")
    if modes := watched.modes():
        yield _line("modes", ", ".join(_mode(mode, glyphs) for mode in modes))
    yield from _excitation(values)
    line = Text(no_wrap=True)
    if (delay := watched.number("delay [s]")) is not None:
        confidence = CONFIDENCE.get(values["delay confidence"], "")
        line += _line("delay", (f"{1e3 * delay:.0f} ms", "bold"), f"  {confidence}  ")
    if lag := values.get("servo lag [s]"):
        line += _line("servo lag", f"{lag} s  ")
    if count := values.get("ticks: count"):
        cost = values.get("ticks: update time p99 [ms]")
        line += _line("ticks", count, f"  update {cost} ms (p99)" if cost else "")
    if line:
        yield line
    collinear = values.get("collinear", "nothing")
    if collinear != "nothing":
        yield Text.assemble(("collinear: ", "yellow"), collinear, no_wrap=True)


def _excitation(values: Mapping[str, str]) -> Iterator[Text]:
    """Yield the progress of a run of excitation, or the end of the last one."""
    ended = values.get("excite: last run", "none yet")
    if left := values.get("excite: remaining [s]"):
        until = values["excite: until known [s]"]
        known = f"known in {until} s" if until.isdigit() else "still unknown"
        yield _line(
            "excite",
            (values["excite: state"], "bold magenta"),
            f"  {values['excite: elapsed [s]']} s, at most {left} s left",
            f"  {known}: {values['excite: not known yet']}",
        )
    elif ended != "none yet":
        yield _line("excite", (ended, "yellow" if ended.startswith("aborted") else ""))
