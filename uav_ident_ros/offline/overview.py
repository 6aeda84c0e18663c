# SPDX-License-Identifier: Apache-2.0
"""Several replays, a line each: of many bags, or of many configurations on one, best first."""

from collections import Counter
from collections.abc import Mapping, Sequence

from uav_ident_ros.offline.evidence import FIT_WINDOWS
from uav_ident_ros.offline.flights_table import VERDICTS
from uav_ident_ros.offline.job import Outcome
from uav_ident_ros.offline.status import NO_RESULT, NOT_USABLE
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


def fit_cells(outcome: Outcome, kind: str = "model") -> list[Cell]:
    """Return the 1-second prediction fit of p, q, r over the last windows, or that of holding."""
    fit: Mapping[str, float | None] = dict.fromkeys(AXES)
    if outcome.summary:
        fit = outcome.summary["prediction_fit"][FIT_WINDOWS][kind]
    return [percent(fit[axis]) for axis in AXES]


def overview(outcomes: Sequence[Outcome]) -> str:
    """Return a table of several replays."""
    rows = [Row(o.job.name, [*fit_cells(o), Words(verdict(o))]) for o in outcomes]
    counts = Counter(outcome.status for outcome in outcomes)
    counted = ", ".join(f"{counts[s]} {word}" for s, word in VERDICTS.items() if counts[s])
    kept = sum(outcome.kept for outcome in outcomes)
    before = f"; {kept} of them as replayed before" if kept else ""
    lines = columns(Table("", ("bag", *HEAD, Words("verdict")), rows))
    return "\n".join([*lines, "", f"{len(outcomes)} bags: {counted}{before}"])


def verdict(outcome: Outcome) -> str:
    """Return the verdict on a replay, and the reason where it is not a good one."""
    word = VERDICTS[outcome.status]
    if outcome.status == NO_RESULT:
        return f"{word}: {outcome.warnings[-1].splitlines()[0]}"
    reason = outcome.summary["reason"]
    return f"{word}: {reason}" if outcome.status == NOT_USABLE and reason else word


def mean_fit(outcome: Outcome) -> float:
    """Return the mean over the axes of the 1-second prediction fit, percent."""
    if not outcome.summary:
        return WORST_FIT
    fits = outcome.summary["prediction_fit"][FIT_WINDOWS]["model"].values()
    return sum(WORST_FIT if f is None else max(f, WORST_FIT) for f in fits) / len(fits)


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes, usable ones first, then by their mean fit."""
    return sorted(outcomes, key=lambda outcome: (outcome.status, -mean_fit(outcome)))


def ranking(
    bag: str,  # Name of the bag
    outcomes: Sequence[Outcome],  # One for each configuration
) -> str:
    """Return a table of the configurations of one bag, the best first."""
    rows = []
    for place, outcome in enumerate(ranked(outcomes), start=1):
        mean = Number(mean_fit(outcome) if outcome.summary else None, ".1f")
        delay = Number(outcome.summary.get("delay"), ".3f")
        cells = [*fit_cells(outcome), mean, delay, Words(verdict(outcome))]
        rows.append(Row(f"{place:>2} {outcome.job.name}", cells))
    with_fit = next((o for o in outcomes if o.summary), None)
    if with_fit is not None:
        blank = [NONE, NONE, Words("")]
        rows.append(Row("   holding the rates", [*fit_cells(with_fit, "hold"), *blank]))
    head = ("   configuration", *HEAD, "mean", "delay", Words("verdict"))
    title = (
        f"{bag}: {len(outcomes)} configurations, by their 1-second prediction fit over the last "
        "40 % of the flight [%]\n"
    )
    return "\n".join(columns(Table(title, head, rows)))
