# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks share: the repository, their options, jobs in parallel, figures on disk."""

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

HELP = {
    "seeds": "seeds of each flight",
    "seed": "seed of everything",
    "workers": "processes",
    "output": "where the figures go",
}
"""Options that several programs have, in words."""

Job = TypeVar("Job")
Result = TypeVar("Result")


def parser(text: str | None, **options: Any) -> argparse.ArgumentParser:
    """Return a parser with the program's docstring and options, given with their defaults."""
    found = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in options.items():
        words = f"{HELP.get(name, name)} ({default})"
        found.add_argument(f"--{name}", type=type(default), default=default, help=words)
    return found


def done(
    function: Callable[[Job], Result],
    jobs: Iterable[Job],
    workers: int,
    printed: Callable[[Result], object] = str,  # The line on a result
) -> list[Result]:
    """Return the results of all jobs, by processes of their own; a line on each as it comes."""
    results = []
    with get_context("spawn").Pool(workers) as pool:
        for result in pool.imap(function, jobs):
            print(printed(result), flush=True)
            results.append(result)
    return results


def grouped(
    results: Iterable[dict[str, Any]], *keys: str
) -> dict[tuple[Any, ...], list[dict[str, Any]]]:
    """Return the results that are alike in some keys, by these, in the order of the first ones."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for result in results:
        groups.setdefault(tuple(result[key] for key in keys), []).append(result)
    return groups


def resident_mb(pid: int | str = "self") -> float:
    """Resident memory of a process, MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def peak_mb(pid: int | str = "self") -> float:
    """Largest resident memory of a process so far, MiB; NaN once it has ended.

    Not ru_maxrss: that begins with the memory of whoever forked it.
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
