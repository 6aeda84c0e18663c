# SPDX-License-Identifier: Apache-2.0
"""Kill the node while it saves, again and again: ``python benchmarks/kills.py``.

A node is fed a recorded flight and asked to save without a pause. At a random moment it is killed
(SIGKILL). The state file must then be whole, the next node must start from it, and the
coefficients that it publishes first must be those of the file, to the bit.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from uav_ident_ros.identification.structure import FloatArray
    from uav_ident_ros.player import Player

ROOT = Path(__file__).resolve().parents[1]
BAG = ROOT / "bags" / "multisine"
TOPICS = ("/imu/data", "/actuators")

LONGEST_LIFE = 1.5
"""The node is killed within so many seconds from its first file, s."""

STEP = 0.005
"""Interval of the calls of ~/save, s."""

PATIENCE = 60.0
"""Seconds in which a node on a busy machine has written its first file."""

SPEED = 4.0
"""Speed of the flight, relative to real time."""


@dataclass
class Kills:
    """What came of a campaign."""

    killed: int = 0  # Nodes killed
    saves: int = 0  # Files that they had written, as they said
    # Kills in the middle of a file: they left the beginning of one beside the whole one
    interrupted: int = 0
    problems: list[str] = field(default_factory=list)  # What should not have been


GOOD = "every file was whole, every node went on from it"
"""What is said if there was no problem."""


class Feeder:
    """Feeds a flight to the node, asks it to save, and hears what it publishes."""

    def __init__(self) -> None:
        from std_srvs.srv import Trigger

        from uav_ident_ros.bags.reading import Bag
        from uav_ident_ros.messages.types import import_type
        from uav_ident_ros.player import Player

        with Bag(BAG) as bag:
            classes = {topic: import_type(bag.type_of(topic)) for topic in TOPICS}
            messages = list(bag.messages(TOPICS))
        self.player: Player = Player(classes, clock=False)
        self._messages = cycle(messages)
        self._next = next(self._messages)
        self._request = Trigger.Request()
        self._save = self.player.node.create_client(Trigger, "/identifier/save")
        self._answers: list = []

    def feed(self, seconds: float) -> None:
        """Play the next `seconds` of wall time of the flight."""
        end = self._next.log_ns + int(seconds * SPEED * 1e9)
        while self._next.log_ns <= end:
            before = self._next.log_ns
            self.player.send(self._next.topic, self._next.data)
            self._next = next(self._messages)
            if self._next.log_ns < before:
                break
        self.player.spin_for(seconds)

    def ask_to_save(self) -> None:
        """Call ~/save, without waiting for the answer."""
        self._answers.append(self._save.call_async(self._request))

    def saves(self) -> int:
        """Count the files that were written since the last time, as the node said."""
        done = [a for a in self._answers if a.done() and a.result().success]
        for answer in self._answers:
            self._save.remove_pending_request(answer)
        self._answers = []
        return len(done)


def start_node(state_file: Path, log: Path) -> subprocess.Popen[bytes]:
    """Start the node as a process of its own."""
    command = [sys.executable, "-m", "uav_ident_ros.node", "--ros-args"]
    command += ["--params-file", str(BAG / "identifier.yaml")]
    command += ["-p", f"state_file:={state_file}", "-p", "save_period:=1.0"]
    with log.open("wb") as file:
        return subprocess.Popen(command, cwd=ROOT, stdout=file, stderr=file)


def campaign(
    feeder: Feeder,  # Feeds it
    kills: int,  # How often
    seed: int,  # Seed of the moments
    folder: Path,  # Empty folder for the state file and the logs
) -> Kills:
    """Kill the node `kills` times."""
    chance = random.Random(seed)
    result = Kills()
    state_file, log = folder / "state.yaml", folder / "node.log"
    saved: FloatArray | None = None
    for number in range(kills + 1):
        node = start_node(state_file, log)
        try:
            life = chance.uniform(0.0, LONGEST_LIFE)
            _live(feeder, node, state_file, life)
            result.saves += feeder.saves()
        finally:
            node.kill()
            node.wait()
        _check_start(feeder.player, log, saved, number, result)
        if number == kills:
            break
        result.killed += 1
        result.interrupted += any(folder.glob(f".state.yaml.{node.pid}.tmp"))
        saved = _load(state_file, number, result)
    return result


def _live(feeder: Feeder, node: subprocess.Popen[bytes], state_file: Path, life: float) -> None:
    """Feed a node until it has written a file, and `life` seconds more."""
    player = feeder.player
    player.wait_for_node()
    player.outputs.clear()
    before = state_file.stat().st_mtime_ns if state_file.exists() else 0
    limit = time.monotonic() + PATIENCE
    end = limit
    while time.monotonic() < end and node.poll() is None:
        feeder.feed(STEP)
        feeder.ask_to_save()
        if end == limit and state_file.exists() and state_file.stat().st_mtime_ns != before:
            end = time.monotonic() + life


def _load(state_file: Path, number: int, result: Kills) -> FloatArray | None:
    """Read the file that a killed node has left."""
    from uav_ident_ros.files.coefficients_file import CoefficientsFileError, load_with_notes

    try:
        return load_with_notes(state_file)[0].values
    except CoefficientsFileError as error:
        result.problems.append(f"kill {number}: {error}")
        return None


def _check_start(
    player: Player, log: Path, saved: FloatArray | None, number: int, result: Kills
) -> None:
    """Hold what a node published first against the file that it found."""
    if saved is None:
        return
    if "started from" not in log.read_text(encoding="utf-8"):
        result.problems.append(f"start {number}: it did not start from the file")
    if not player.outputs.coefficients:
        result.problems.append(f"start {number}: it published nothing")
    elif not np.array_equal(player.outputs.coefficients[0].data, saved.ravel()):
        result.problems.append(f"start {number}: it did not go on with the values of the file")


def main() -> int:
    """Run the campaign and print what came of it; the exit status is 1 if there is a problem."""
    from uav_ident_ros.domain import own_domain

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    begin = time.monotonic()
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = folder
        feeder = Feeder()
        try:
            result = campaign(feeder, options.kills, options.seed, Path(folder))
            print(
                f"{result.killed} kills, {result.saves} files written, {result.interrupted} killed "
                f"in the middle of one, {time.monotonic() - begin:.0f} s"
            )
            # Said before it leaves: Fast DDS may crash in leaving a graph of killed participants.
            print(*result.problems or [GOOD], sep="\n", flush=True)
        finally:
            feeder.player.close()
    return 1 if result.problems else 0


if __name__ == "__main__":
    sys.exit(main())
