# SPDX-License-Identifier: Apache-2.0
"""Several replays, a line each: of many bags, or of many configurations on one, best first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from uav_ident_ros.offline.evidence import FIT_WINDOWS
from uav_ident_ros.offline.flights_table import VERDICTS
from uav_ident_ros.offline.job import Outcome
from uav_ident_ros.offline.status import NO_RESULT, NOT_USABLE
from uav_ident_ros.offline.summary import AXES

HOLDING = "holding the rates"
WORST_FIT = -100.0
"""Fit below which an axis counts no worse, percent: one that diverges must not hide the others."""

LOWEST_SHOWN = -1000.0
"""Fit below which the number says nothing more, percent."""


def fit_of(outcome: Outcome) -> tuple[float | None, ...]:
    """Return the 1-second prediction fit of p, q, r over the last windows, percent."""
    fit = outcome.summary["prediction_fit"][FIT_WINDOWS]["model"]
    return tuple(fit[axis] for axis in AXES)


def fit_columns(outcome: Outcome) -> str:
    """Return the fit of each axis in columns."""
    return columns(fit_of(outcome) if outcome.summary else [None] * len(AXES))


def columns(values: Iterable[float | None]) -> str:
    """Return percentages in columns; a dash where there is none."""

    def word(value: float | None) -> str:
        if value is None:
            return "-"
        return f"{value:.1f}" if value > LOWEST_SHOWN else f"<{LOWEST_SHOWN:.0f}"

    return "".join(f"{word(value):>8}" for value in values)


def overview(outcomes: Sequence[Outcome]) -> str:
    """Return a table of several replays."""
    width = max(len(outcome.job.name) for outcome in outcomes) + 2
    heads = "".join(f"{f'fit {axis}':>8}" for axis in AXES)
    lines = [f"{'bag':<{width}}{heads}  verdict"]
    for outcome in outcomes:
        lines.append(f"{outcome.job.name:<{width}}{fit_columns(outcome)}  {verdict(outcome)}")
    counts = Counter(outcome.status for outcome in outcomes)
    counted = ", ".join(f"{counts[s]} {word}" for s, word in VERDICTS.items() if counts[s])
    kept = sum(outcome.kept for outcome in outcomes)
    before = f"; {kept} of them as replayed before" if kept else ""
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
    fits = [WORST_FIT if fit is None else max(fit, WORST_FIT) for fit in fit_of(outcome)]
    return sum(fits) / len(fits)


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes, usable ones first, then by their mean fit."""
    return sorted(outcomes, key=lambda outcome: (outcome.status, -mean_fit(outcome)))


def ranking(
    bag: str,  # Name of the bag
    outcomes: Sequence[Outcome],  # One for each configuration
) -> str:
    """Return a table of the configurations of one bag, the best first."""
    width = max(len(HOLDING), *(len(outcome.job.name) for outcome in outcomes)) + 2
    heads = "".join(f"{f'fit {axis}':>8}" for axis in AXES)
    lines = [
        f"{bag}: {len(outcomes)} configurations, by their 1-second prediction fit over the last "
        "40 % of the flight [%]",
        "",
        f"   {'configuration':<{width}}{heads}{'mean':>8}{'delay':>8}  verdict",
    ]
    for place, outcome in enumerate(ranked(outcomes), start=1):
        name = f"{place:>2} {outcome.job.name:<{width}}"
        lines.append(f"{name}{fit_columns(outcome)}{_rest(outcome)}  {verdict(outcome)}")
    holding = next((o.summary for o in outcomes if o.summary), None)
    if holding is not None:
        hold = holding["prediction_fit"][FIT_WINDOWS]["hold"]
        lines.append(f"   {HOLDING:<{width}}{columns([hold[axis] for axis in AXES])}")
    return "\n".join(lines)


def _rest(outcome: Outcome) -> str:
    if not outcome.summary:
        return f"{'-':>8}{'-':>8}"
    return f"{mean_fit(outcome):>8.1f}{outcome.summary['delay']:>8.3f}"
