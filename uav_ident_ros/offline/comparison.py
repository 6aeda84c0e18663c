# SPDX-License-Identifier: Apache-2.0
"""Several configurations on one bag, the best first."""

from __future__ import annotations

from collections.abc import Sequence

from uav_ident_ros.offline.evidence import FIT_WINDOWS
from uav_ident_ros.offline.job import Outcome
from uav_ident_ros.offline.overview import columns, fit_columns, fit_of, verdict
from uav_ident_ros.offline.summary import AXES

HOLDING = "holding the rates"
WORST_FIT = -100.0
"""Fit below which an axis counts no worse, percent: one that diverges must not hide the others."""


def mean_fit(outcome: Outcome) -> float:
    """Return the mean over the axes of the 1-second prediction fit, percent."""
    if not outcome.summary:
        return WORST_FIT
    fits = [WORST_FIT if fit is None else max(fit, WORST_FIT) for fit in fit_of(outcome)]
    return sum(fits) / len(fits)


def ranked(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes, usable ones first, then by their mean fit."""
    return sorted(outcomes, key=lambda outcome: (outcome.status, -mean_fit(outcome)))


def ranking(bag: str, outcomes: Sequence[Outcome]) -> str:
    """Return a table of the configurations of one bag, the best first.

    Parameters
    ----------
    bag : str
        Name of the bag.
    outcomes : sequence of Outcome
        One for each configuration.
    """
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
