# SPDX-License-Identifier: Apache-2.0
"""The command `replay`: one bag, many bags, or many configurations of one bag."""

import argparse
import os
import sys
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from uav_ident_ros.bags.reading import STORAGE_SUFFIXES, BagError
from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.commandline import end_as_on_ctrl_c, reader_has_gone
from uav_ident_ros.identification.structure import RATES
from uav_ident_ros.offline import NO_RESULT
from uav_ident_ros.offline.find import find_bags, names_of
from uav_ident_ros.offline.fleet import arrow, rows_of, write_flights
from uav_ident_ros.offline.job import VERDICTS, Job, Outcome, parameters_beside, replay, reserved
from uav_ident_ros.offline.parallel import replay_all
from uav_ident_ros.offline.tables import NONE, Cell, Number, Row, Table, Words, columns, write_table

WORST_FIT = -100.0
"""Lower limit of an axis in the mean fit, percent: one that diverges must not hide the others."""

LOWEST_SHOWN = -1000.0
"""Lowest fit shown as a number, percent."""

HEAD = tuple(f"fit {axis}" for axis in RATES)


def percent(value: float | None) -> Cell:
    """Return a percentage, or the lower limit if it is below that."""
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


# --- from the options to the exit status ----------------------------------------------------------


def run(command_line: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Run the command with its options; return the exit status, see `replay --help`."""
    try:
        several = len(options.bags) > 1 or find_bags(options.bags[0]) != options.bags
        if options.compare and several:
            command_line.error("--compare takes one bag")
        name = options.bags[0].resolve().stem
        folder = options.output or Path("" if several else f"replay_{name}")
        with reserved(folder):
            if options.compare:
                return _compare(options, name, folder)
            return _many(options, folder) if several else _one(options, name, folder)
    except (BagError, BagWriteError) as error:
        _warn(str(error))
    except Exception:
        # Python's own status for it, 1, would mean a result.
        traceback.print_exc()
    return NO_RESULT


def _job(options: argparse.Namespace, bag: Path, name: str, folder: Path, *files: Path) -> Job:
    return Job(
        bag,
        name,
        folder,
        (*options.params_file, *files),
        options.node,
        dict(options.topic),
        options.plot,
        options.report,
        options.aircraft or bag.resolve().parent.name,
        # comparisons may be of code under development, of the same version
        again=options.again or bool(options.compare),
    )


def _one(options: argparse.Namespace, name: str, folder: Path) -> int:
    (bag,) = options.bags
    outcome = replay(_job(options, bag, name, folder), shown=True)
    doubt = outcome.summary["doubt"] if outcome.summary else ""
    _warn(*(text for text in outcome.warnings if not (doubt and text.endswith(doubt))))
    if outcome.summary:
        _print(f"{write_table(outcome.summary)}\n\nwritten to {folder}{os.sep}")
    return outcome.status


def _all(jobs: Sequence[Job], options: argparse.Namespace) -> list[Outcome]:
    """Run the jobs and print their warnings."""
    end_as_on_ctrl_c()
    outcomes = replay_all(jobs, options.jobs, options.scheduler)
    _warn(*(f"{o.job.name}: {warning}" for o in outcomes for warning in o.warnings))
    return outcomes


def _many(options: argparse.Namespace, folder: Path) -> int:
    arrow()  # fails before the replays, which may take hours
    bags, own = _bags_of(options.bags), "{}" if options.output else "replay_{}"
    named = zip(bags, names_of(bags), strict=True)
    jobs = [_job(options, bag, name, folder / own.format(name)) for bag, name in named]
    outcomes = _all(jobs, options)
    if unread := [] if options.params_file else [*filter(None, map(parameters_beside, bags))]:
        _warn(
            f"{len(unread)} bags have a parameter file beside them, which was not read, as "
            f"{unread[0]}: give one of all bags as --params-file, or replay each bag by itself"
        )
    rows = [row for outcome in outcomes for row in rows_of(outcome)]
    tables = ", ".join(map(str, write_flights(folder, rows)))
    written = options.output or own.format("NAME")
    _print(f"{overview(outcomes)}\n\nwritten to {written}{os.sep}; table: {tables}")
    return max(outcome.status for outcome in outcomes)


def _bags_of(paths: Sequence[Path]) -> list[Path]:
    """Return the bags of some paths; an empty folder stays, to be reported without a result."""
    found = [find_bags(path) for path in paths]
    if not any(found):
        raise BagError(
            f"folder '{paths[0]}' has no bags: neither rosbag2 folders nor "
            f"{' or '.join(STORAGE_SUFFIXES)} files"
        )
    return [bag for path, bags in zip(paths, found, strict=True) for bag in bags or [path]]


def _compare(options: argparse.Namespace, name: str, folder: Path) -> int:
    (bag,) = options.bags
    named = zip(options.compare, names_of(options.compare), strict=True)
    jobs = [_job(options, bag, label, folder / label, file) for file, label in named]
    outcomes = _all(jobs, options)
    _print(f"{ranking(name, outcomes)}\n\nwritten to {folder}{os.sep}")
    best, failed = ranked(outcomes)[0], any(o.status == NO_RESULT for o in outcomes)
    return NO_RESULT if failed else best.status


def _warn(*warnings: str) -> None:
    for warning in warnings:
        print(f"replay: {warning}", file=sys.stderr)


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:
        reader_has_gone()
