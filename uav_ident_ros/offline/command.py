# SPDX-License-Identifier: Apache-2.0
"""`replay` from the command line to the exit status."""

import argparse
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.offline.find import find_bags, is_collection, names_of
from uav_ident_ros.offline.flights_table import write_flights
from uav_ident_ros.offline.job import Job, Outcome, replay
from uav_ident_ros.offline.overview import overview, ranked, ranking
from uav_ident_ros.offline.parallel import replay_all
from uav_ident_ros.offline.progress import Progress
from uav_ident_ros.offline.status import NO_RESULT

DEFAULT_FOLDER = "replay_{}"
INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""


def run(command_line: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Run the command with its options; return the exit status, see `replay --help`."""
    try:
        if options.compare:
            if len(options.bags) > 1 or is_collection(options.bags[0]):
                command_line.error("--compare takes one bag")
            return _compare(options)
        if len(options.bags) > 1 or is_collection(options.bags[0]):
            return _many(options)
        return _one(options)
    except (BagError, BagWriteError) as error:
        _tell([str(error)])
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception:
        # Python's own status for it, 1, would say that there is a result.
        traceback.print_exc()
    return NO_RESULT


def _job(options: argparse.Namespace, bag: Path, name: str, folder: Path) -> Job:
    files = (options.params_file,) if options.params_file else ()
    return Job(
        bag,
        name,
        folder,
        files,
        options.node,
        dict(options.topic),
        options.plot,
        options.report,
        options.aircraft or bag.resolve().parent.name,
        # what is compared may be code under work, which no version tells apart
        again=options.again or bool(options.compare),
    )


def _one(options: argparse.Namespace) -> int:
    (bag,) = options.bags
    name = bag.resolve().stem
    folder = options.output or Path(DEFAULT_FOLDER.format(name))
    with closing(Progress()) as progress:
        outcome = replay(_job(options, bag, name, folder), progress)
    _tell(outcome.warnings)
    if outcome.table:
        _print(f"{outcome.table}\n\n{_written(folder)}")
    return outcome.status


def _many(options: argparse.Namespace) -> int:
    bags = [bag for path in options.bags for bag in _bags_of(path, len(options.bags) > 1)]
    jobs = []
    for bag, name in zip(bags, names_of(bags), strict=True):
        default = Path(DEFAULT_FOLDER.format(name))
        jobs.append(_job(options, bag, name, options.output / name if options.output else default))
    where = options.output or Path()
    outcomes = replay_all(jobs, options.jobs, options.scheduler)
    tables = write_flights(where, outcomes)
    _tell_of_several(outcomes)
    folders = _written(options.output or Path(DEFAULT_FOLDER.format("NAME")))
    _print(f"{overview(outcomes)}\n\n{folders}; table: {', '.join(map(str, tables))}")
    return max(outcome.status for outcome in outcomes)


def _bags_of(path: Path, one_of_several: bool) -> list[Path]:
    """Return the bags that a path stands for; an empty folder must not stop the others."""
    if not is_collection(path):
        return [path]
    try:
        return find_bags(path)
    except BagError:
        if not one_of_several:
            raise
        return [path]


def _compare(options: argparse.Namespace) -> int:
    (bag,) = options.bags
    name = bag.resolve().stem
    folder = options.output or Path(DEFAULT_FOLDER.format(name))
    base = _job(options, bag, name, folder)
    jobs = [
        replace(base, name=label, folder=folder / label, params_files=(*base.params_files, file))
        for file, label in zip(options.compare, names_of(options.compare), strict=True)
    ]
    outcomes = replay_all(jobs, options.jobs, options.scheduler)
    _tell_of_several(outcomes)
    _print(f"{ranking(name, outcomes)}\n\n{_written(folder)}")
    best = ranked(outcomes)[0]
    failed = any(outcome.status == NO_RESULT for outcome in outcomes)
    return NO_RESULT if failed else best.status


def _written(folder: Path) -> str:
    return f"written to {folder}{os.sep}"


def _tell(warnings: Sequence[str]) -> None:
    for warning in warnings:
        print(f"replay: {warning}", file=sys.stderr)


def _tell_of_several(outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        _tell([f"{outcome.job.name}: {warning}" for warning in outcome.warnings])


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # The reader has gone; there is nobody left to tell, not at the exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
