# SPDX-License-Identifier: Apache-2.0
"""How fast `replay` is: ``python benchmarks/offline_speed.py``.

Simulates ten minutes of flight into a bag (200 Hz Imu, 50 Hz actuators), replays it with the
default estimator, and prints where the time goes: as a multiple of real time, and of what rosbags
needs just to iterate over the raw messages, measured in the same run. Times are processor times
of the one core in use, so that other work on the machine disturbs them little; the best of several
rounds counts.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import bench
from rosbags.rosbag2 import Reader

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.offline.evidence import measure
from uav_ident_ros.offline.inputs import choose_inputs
from uav_ident_ros.offline.job import write_results
from uav_ident_ros.offline.run import OfflineRun
from uav_ident_ros.offline.summary import Replayed
from uav_ident_ros.simulation.cli import main as simulate

IMU_RATE, ACTUATOR_RATE = 200, 50
"""Hz."""

NODE = "/identifier"
READING, TICKS, SCORING, ADVICE, WRITING = "reading", "ticks", "scoring", "advice", "writing"

Result = TypeVar("Result")
Split = dict[str, float]


class TimedRun(OfflineRun):
    """A run that knows how long its ticks take, s."""

    tick_time = 0.0

    def _tick(self) -> None:
        if self.identifier.intake.due is not None:
            start = time.process_time()
            super()._tick()
            self.tick_time += time.process_time() - start


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    """Return the processor time of some work, s, and its result."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def iterate_raw(path: Path) -> int:
    """Iterate over a bag with rosbags, doing nothing with the messages; return their number."""
    with Reader(path) as reader:
        return sum(1 for _ in reader.messages())


def replay(path: Path, output: Path) -> tuple[Split, OfflineRun]:
    """Do what the command does with one bag; return the time of each part, s, and the run."""
    split: Split = {}

    def run() -> TimedRun:
        values = load_parameters(path / "identifier.yaml", NODE)
        with Bag(path) as bag:
            timed_run = TimedRun(choose_inputs(bag, values))
            timed_run.run(bag, lambda messages, _: messages)
        return timed_run

    whole, done = timed(run)
    split[TICKS] = done.tick_time
    split[READING] = whole - done.tick_time
    split[SCORING], fits = timed(done.score)
    split[ADVICE], evidence = timed(lambda: measure(done, fits))
    replayed = Replayed("flight", path, done, fits, evidence)
    split[WRITING], _ = timed(lambda: write_results(output, replayed, NODE))
    return split, done


def report(seconds: float, messages: int, raw: float, split: Split, run: OfflineRun) -> str:
    """Return the table."""
    total = sum(split.values())
    lines = [
        f"{seconds:.0f} s of flight, {messages} messages, {len(run.estimates)} ticks of "
        f"{run.inputs.settings.estimator}",
        "",
        f"{'':<22}{'s':>8}{'share':>8}{'x rosbags raw':>15}{'x real time':>13}",
        f"{'rosbags, raw':<22}{raw:>8.3f}{'':>8}{1.0:>15.1f}{seconds / raw:>13.0f}",
        f"{'replay':<22}{total:>8.3f}{'':>8}{total / raw:>15.1f}{seconds / total:>13.0f}",
    ]
    for name in (READING, TICKS, SCORING, ADVICE, WRITING):
        part = split[name]
        share = f"{100.0 * part / total:.0f} %"
        lines.append(
            f"{f'  {name}':<22}{part:>8.3f}{share:>8}{part / raw:>15.1f}{seconds / part:>13.0f}"
        )
    per_tick = 1e6 * split[TICKS] / len(run.estimates)
    return "\n".join([*lines, "", f"a tick takes {per_tick:.0f} us"])


def main() -> None:
    """Simulate, measure, print."""
    options = bench.parser(__doc__, minutes=10.0, rounds=3).parse_args()
    seconds = 60.0 * options.minutes
    with tempfile.TemporaryDirectory() as folder:
        path, output = Path(folder) / "flight", Path(folder) / "output"
        arguments = ["--output", str(path), "--duration", str(seconds)]
        arguments += ["--imu-rate", str(IMU_RATE), "--actuator-rate", str(ACTUATOR_RATE)]
        if simulate(arguments):
            raise SystemExit("simulate failed")
        raws, splits = [], []
        for _ in range(options.rounds):
            raw, messages = timed(lambda: iterate_raw(path))
            split, run = replay(path, output)
            raws.append(raw)
            splits.append(split)
    best = min(splits, key=lambda split: sum(split.values()))
    print(report(seconds, messages, min(raws), best, run))


if __name__ == "__main__":
    main()
