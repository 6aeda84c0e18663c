# SPDX-License-Identifier: Apache-2.0
"""Repeated ends of the node: ``python benchmarks/endings.py kills``, or ``signals``.

kills      The node saves continually and is killed at a random moment. The state file must be
           whole, and the first output of the next node must equal it, to the bit.
signals    At a random moment of its start or of learning, the node receives one to three SIGINT or
           SIGTERM, as from a terminal and from launch together. It must end with status 0 and
           without a traceback, and save its coefficients.
"""

import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import bench
import numpy as np
from bench import ACTUATORS_TOPIC, MULTISINE, RATES_TOPIC
from std_srvs.srv import Trigger

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.files.coefficients_file import CoefficientsFileError, load_with_notes
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import import_type
from uav_ident_ros.player import Player
from uav_ident_ros.process import NodeProcess, own_domain

sys.path.insert(0, str(bench.ROOT / "test"))

from programs import handled

TOPICS = (RATES_TOPIC, ACTUATORS_TOPIC)

LONGEST_LIFE = 1.5, 4.0
"""Longest time from the first state file to the kill; and from the start of signal handling, or of
learning, to the signals; s."""

GAPS = (0.0, 0.001, 0.01, 0.1, 0.3)
"""Times between two signals, s, some within the writing of the file."""

STEP = 0.005
"""Wall time of a piece of the flight that is sent at once, s."""

PATIENCE = 60.0
"""Longest time for a start or an end of the node, s, sufficient on a busy machine."""

SPEED = 4.0
"""Playing speed, relative to real time."""


class Feeder:
    """Player of a flight that requests saves and collects the node's outputs."""

    def __init__(self) -> None:
        with Bag(MULTISINE) as bag:
            classes = {topic: import_type(bag.type_of(topic)) for topic in TOPICS}
            messages = list(bag.messages(TOPICS))
        self.player = Player(classes, clock=False)
        self._messages = cycle(messages)
        self._next = next(self._messages)
        self._request = Trigger.Request()
        self._save = self.player.node.create_client(Trigger, "/identifier/save")
        self._answers: list[Any] = []

    def feed(self) -> None:
        """Play the next `STEP` of wall time of the flight."""
        end = self._next.log_ns + int(STEP * SPEED * 1e9)
        while self._next.log_ns <= end:
            before = self._next.log_ns
            self.player.send(self._next.topic, self._next.data)
            self._next = next(self._messages)
            if self._next.log_ns < before:
                break
        self.player.spin_for(STEP)

    def request_save(self) -> None:
        """Call ~/save without waiting for the response."""
        self._answers.append(self._save.call_async(self._request))

    def saves(self) -> int:
        """Return the number of successful saves since the last call, by the node's responses."""
        done = [a for a in self._answers if a.done() and a.result().success]
        for answer in self._answers:
            self._save.remove_pending_request(answer)
        self._answers = []
        return len(done)

    def learned(self) -> bool:
        """Return whether the last coefficients are not all zero."""
        coefficients = self.player.outputs.coefficients
        return bool(coefficients) and any(coefficients[-1].data)


@contextmanager
def running(state_file: Path, log: Path) -> Iterator[NodeProcess]:
    """Run the node in a process of its own, and kill it at the end."""
    log.unlink(missing_ok=True)
    values = {"state_file": state_file, "save_period": 1.0}
    node = NodeProcess("uav_ident_ros.node", log, values, file=MULTISINE / "identifier.yaml")
    try:
        yield node
    finally:
        node.kill()
        node.wait()


# --- kills -----------------------------------------------------------------------------------


def kills(feeder: Feeder, count: int, chance: random.Random, folder: Path, wrong: list[str]) -> str:
    """Kill nodes and return a summary; problems are appended to `wrong`."""
    state_file, log = folder / "state.yaml", folder / "node.log"
    saved: FloatArray | None = None
    saves = interrupted = 0
    for number in range(count + 1):
        with running(state_file, log) as node:
            _live_until_saved(feeder, node, state_file, chance.uniform(0.0, LONGEST_LIFE[0]))
            saves += feeder.saves()
        if saved is not None:
            published = feeder.player.outputs.coefficients
            if "started from" not in node.log:
                wrong.append(f"start {number}: it did not start from the file")
            if not published:
                wrong.append(f"start {number}: it published nothing")
            elif not np.array_equal(published[0].data, saved.ravel()):
                wrong.append(f"start {number}: it did not go on with the values of the file")
        if number < count:
            interrupted += any(folder.glob(f".state.yaml.{node.pid}.tmp"))
            saved = load(state_file, number, wrong)
    return f"{count} kills, {saves} files written, {interrupted} killed in the middle of one"


def _live_until_saved(feeder: Feeder, node: NodeProcess, state_file: Path, life: float) -> None:
    """Play to a node until it has written a file, and for `life` seconds more."""
    feeder.player.wait_for_node()
    feeder.player.outputs.clear()
    before = state_file.stat().st_mtime_ns if state_file.exists() else 0
    limit = time.monotonic() + PATIENCE
    end = limit
    while time.monotonic() < end and node.poll() is None:
        feeder.feed()
        feeder.request_save()
        if end == limit and state_file.exists() and state_file.stat().st_mtime_ns != before:
            end = time.monotonic() + life


def load(state_file: Path, number: int, wrong: list[str]) -> FloatArray | None:
    """Return the coefficients in the state file of a killed node."""
    try:
        return load_with_notes(state_file)[0].values
    except CoefficientsFileError as error:
        wrong.append(f"kill {number}: {error}")
        return None


# --- signals ---------------------------------------------------------------------------------


def signals(
    feeder: Feeder, count: int, chance: random.Random, folder: Path, wrong: list[str]
) -> str:
    """End nodes by signals; otherwise as `kills`."""
    learned = saved = 0
    for number in range(count):
        state_file, log = folder / f"{number}.yaml", folder / f"{number}.log"
        with running(state_file, log) as node:
            life = chance.uniform(0.0, LONGEST_LIFE[1])
            _live_until_learned(feeder, node, life, started=number % 2 == 1)
            has_learned = feeder.learned()
            for _ in range(chance.randint(1, 3)):
                if node.poll() is None:
                    node.send_signal(chance.choice((signal.SIGINT, signal.SIGTERM)))
                time.sleep(chance.choice(GAPS))
            status = node.wait(PATIENCE)
        learned, saved = learned + has_learned, saved + state_file.exists()
        printed = node.log
        if status != 0 or "Traceback" in printed or "FATAL" in printed:
            wrong.append(f"run {number}: status {status}: {printed[-300:]}")
        if has_learned and not state_file.exists():
            wrong.append(f"run {number}: what was learned is lost")
    return f"{count} nodes ended; {learned} had learned, {saved} left a file"


def _live_until_learned(feeder: Feeder, node: NodeProcess, life: float, *, started: bool) -> None:
    """Play to a node for `life` s after it handles signals or, if `started`, has learned."""
    limit = time.monotonic() + PATIENCE
    while not handled(node.pid, signal.SIGTERM) and time.monotonic() < limit:
        time.sleep(STEP)
    feeder.player.spin_for(0.2)  # receive the last node's outputs first
    feeder.player.outputs.clear()
    while started and not feeder.learned() and time.monotonic() < limit:
        feeder.feed()
    end = time.monotonic() + life
    while time.monotonic() < end:
        feeder.feed()


PROGRAMS: dict[str, tuple[Callable[..., str], int, str]] = {
    "kills": (kills, 50, "every file was whole, every node went on from it"),
    "signals": (signals, 200, "every node ended with status 0, and saved what it had learned"),
}
"""The campaigns, with the number of nodes and the line for a run without problems."""


def main() -> int:
    """Run a campaign and print its result; return the exit status, 1 if there is a problem."""
    parser = bench.parser(__doc__, seed=1, count=0)
    parser.add_argument("name", choices=tuple(PROGRAMS))
    options = parser.parse_args()
    run, usual, good = PROGRAMS[options.name]
    wrong: list[str] = []
    with own_domain(), tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = folder
        feeder = Feeder()
        try:
            count, chance = options.count or usual, random.Random(options.seed)
            print(run(feeder, count, chance, Path(folder), wrong))
            # Print first: Fast DDS may crash when it leaves a graph of killed participants.
            print(*wrong or [good], sep="\n", flush=True)
        finally:
            feeder.player.close()
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
