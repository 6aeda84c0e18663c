# SPDX-License-Identifier: Apache-2.0
"""Several replays beside one another: of many bags, or of many configurations of one."""

from collections import Counter
from collections.abc import Sequence

from uav_ident_ros.offline.job import VERDICTS, Outcome
from uav_ident_ros.offline.tables import AXES, NONE, Cell, Number, Row, Table, Words, columns

WORST_FIT = -100.0
"""Fit below which an axis counts no worse, percent: one that diverges must not hide the others."""

LOWEST_SHOWN = -1000.0
"""Fit below which the number says nothing more, percent."""

HEAD = tuple(f"fit {axis}" for axis in AXES)


def percent(value: float | None) -> Cell:
    """Return a percentage, or that it is below all that says something."""
    if value is not None and value <= LOWEST_SHOWN:
        return f"<{LOWEST_SHOWN:.0f}"
    return Number(value, ".1f")


def overview(outcomes: Sequence[Outcome]) -> str:
    """Return a table of several replays."""
    rows = [Row(o.job.name, [*map(percent, o.fit().values()), Words(o.verdict)]) for o in outcomes]
    counts = Counter(outcome.status for outcome in outcomes)
    counted = ", ".join(f"{counts[s]} {word}" for s, word in VERDICTS.items() if counts[s])
    kept = sum(outcome.kept for outcome in outcomes)
    before = f"; {kept} of them as replayed before" if kept else ""
    lines = columns(Table("", ("bag", *HEAD, Words("verdict")), rows))
    return "\n".join([*lines, "", f"{len(outcomes)} bags: {counted}{before}"])


def mean_fit(outcome: Outcome) -> float:
    """Return the mean over the axes of the 1-second prediction fit, percent."""
    fits = outcome.fit().values()
    return sum(WORST_FIT if f is None else max(f, WORST_FIT) for f in fits) / len(fits)


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes, usable ones first, then by their mean fit."""
    return sorted(outcomes, key=lambda outcome: (outcome.status, -mean_fit(outcome)))


def ranking(bag: str, outcomes: Sequence[Outcome]) -> str:
    """Return a table of the configurations of one bag, the best first."""
    rows = []
    for place, outcome in enumerate(ranked(outcomes), start=1):
        mean = Number(mean_fit(outcome) if outcome.summary else None, ".1f")
        delay = Number(outcome.summary.get("delay"), ".3f")
        cells = [*map(percent, outcome.fit().values()), mean, delay, Words(outcome.verdict)]
        rows.append(Row(f"{place:>2} {outcome.job.name}", cells))
    for with_fit in [o for o in outcomes if o.summary][:1]:
        hold = [*map(percent, with_fit.fit("hold").values()), NONE, NONE, Words("")]
        rows.append(Row("   holding the rates", hold))
    head = ("   configuration", *HEAD, "mean", "delay", Words("verdict"))
    title = (
        f"{bag}: {len(outcomes)} configurations, by their 1-second prediction fit over the last "
        "40 % of the flight [%]\n"
    )
    return "\n".join(columns(Table(title, head, rows)))
