# SPDX-License-Identifier: Apache-2.0
"""Common parts of the benchmarks: repository, options, parallel jobs, figures on disk."""

import argparse
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import uav_ident_ros  # noqa: F401  (before NumPy: it limits its threads)

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build"

MULTISINE = ROOT / "bags" / "multisine"
RATES_TOPIC, ACTUATORS_TOPIC, AIRSPEED_TOPIC = "/imu/data", "/actuators", "/airspeed"
"""Topics of the bags."""

HELP = {
    "seeds": "seeds of each flight",
    "seed": "seed of everything",
    "workers": "processes",
    "output": "where the figures go",
}
"""Help texts of common options."""

Job = TypeVar("Job")
Result = TypeVar("Result")


def parser(text: str | None, **options: Any) -> argparse.ArgumentParser:
    """Return a parser with the program's docstring and the options, with their defaults."""
    found = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in options.items():
        description = f"{HELP.get(name, name)} ({default})"
        found.add_argument(f"--{name}", type=type(default), default=default, help=description)
    return found


def done(
    function: Callable[[Job], Result],
    jobs: Iterable[Job],
    workers: int,
    printed: Callable[[Result], object] = str,  # The line on a result
) -> list[Result]:
    """Run all jobs in processes of their own, print a line on each, return the results."""
    results = []
    with get_context("spawn").Pool(workers) as pool:
        for result in pool.imap(function, jobs):
            print(printed(result), flush=True)
            results.append(result)
    return results


def grouped(
    results: Iterable[dict[str, Any]], *keys: str
) -> dict[tuple[Any, ...], list[dict[str, Any]]]:
    """Return the results grouped by the values of some keys, in order of appearance."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for result in results:
        groups.setdefault(tuple(result[key] for key in keys), []).append(result)
    return groups


def resident_mb(pid: int | str = "self") -> float:
    """Return the resident memory of a process, MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def peak_mb(pid: int | str = "self") -> float:
    """Return the peak resident memory of a process, MiB; NaN once it has ended.

    ru_maxrss does not serve: it includes the memory of the parent before the fork.
    """
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    return int(found[1]) / 1024 if found else math.nan


def keep(path: Path, figures: Any) -> None:
    """Write figures as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(figures, indent=1), encoding="utf-8")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    for line in (head, ["---"] * len(head), *rows):
        yield f"| {' | '.join(line)} |"
