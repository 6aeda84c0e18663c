# SPDX-License-Identifier: Apache-2.0
"""End the node with one to three signals, again and again: ``python benchmarks/signals.py``.

A node is fed a recorded flight. At a random moment, every other time while it starts and every
other time while it learns, it gets SIGINT or SIGTERM, often twice or three times, as from a
terminal and from launch together. It must end with status 0 and without a traceback, and what it
has learned must be in the state file.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from kills import Feeder, start_node

if TYPE_CHECKING:
    from uav_ident_ros.player import Outputs

LONGEST_LIFE = 4.0
"""The signals come within so many seconds from when the node heeds them, or learns, s."""

GAPS = (0.0, 0.001, 0.01, 0.1, 0.3)
"""Times between two signals, s: together, and while the file is written."""

FEED_TIME = 0.02
"""Wall time of the flight that is fed at once, s."""

PATIENCE = 60.0
"""Seconds that a busy machine may take to start the node, or to end it."""

GOOD = "every node ended with status 0, and saved what it had learned"
"""What is said if there was no problem."""


@dataclass
class Endings:
    """What came of a campaign."""

    # runs, learned, saved: Nodes ended; those that had learned something; those that left a file
    runs: int = 0
    learned: int = 0
    saved: int = 0
    problems: list[str] = field(default_factory=list)  # What should not have been


def campaign(feeder: Feeder, runs: int, seed: int, folder: Path) -> Endings:
    """End `runs` nodes; `folder` takes a state file and a log of each."""
    chance = random.Random(seed)
    result = Endings()
    for number in range(runs):
        state_file, log = folder / f"{number}.yaml", folder / f"{number}.log"
        node = start_node(state_file, log)
        try:
            life = chance.uniform(0.0, LONGEST_LIFE)
            learned = _live(feeder, node, life, started=number % 2 == 1)
            _end(node, chance)
            status = node.wait(PATIENCE)
        finally:
            node.kill()
            node.wait()
        result.runs += 1
        result.learned += learned
        result.saved += state_file.exists()
        said = log.read_text(encoding="utf-8", errors="replace")
        if status != 0 or "Traceback" in said or "FATAL" in said:
            result.problems.append(f"run {number}: status {status}: {said[-300:]}")
        if learned and not state_file.exists():
            result.problems.append(f"run {number}: what was learned is lost")
    return result


def _live(feeder: Feeder, node: subprocess.Popen[bytes], life: float, *, started: bool) -> bool:
    """Feed a node for `life` seconds, from when it has `started`; return whether it has learned."""
    limit = time.monotonic() + PATIENCE
    while not _heeds(node.pid) and time.monotonic() < limit:
        time.sleep(0.005)
    feeder.player.spin_for(0.2)  # what the last node has said
    outputs = feeder.player.outputs
    outputs.clear()
    while started and not _has_learned(outputs) and time.monotonic() < limit:
        feeder.feed(FEED_TIME)
    end = time.monotonic() + life
    while time.monotonic() < end:
        feeder.feed(FEED_TIME)
    return _has_learned(outputs)


def _has_learned(outputs: Outputs) -> bool:
    return bool(outputs.coefficients) and any(outputs.coefficients[-1].data)


def _heeds(pid: int) -> bool:
    """Whether a process has a handler for SIGTERM."""
    status = Path(f"/proc/{pid}/status").read_text()
    caught = int(status.split("SigCgt:")[1].split()[0], 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def _end(node: subprocess.Popen[bytes], chance: random.Random) -> None:
    for _ in range(chance.randint(1, 3)):
        if node.poll() is None:
            node.send_signal(chance.choice((signal.SIGINT, signal.SIGTERM)))
        time.sleep(chance.choice(GAPS))


def main() -> int:
    """Run the campaign and print what came of it; the exit status is 1 if there is a problem."""
    from uav_ident_ros.domain import own_domain

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = folder
        feeder = Feeder()
        try:
            result = campaign(feeder, options.runs, options.seed, Path(folder))
        finally:
            feeder.player.close()
    print(f"{result.runs} nodes ended; {result.learned} had learned, {result.saved} left a file")
    print(*result.problems or [GOOD], sep="\n", flush=True)
    return 1 if result.problems else 0


if __name__ == "__main__":
    sys.exit(main())
