# SPDX-License-Identifier: Apache-2.0
"""Many bags at once: ``python benchmarks/fleet_campaign.py``.

Simulates 200 short flights and replays them with `replay`: on the process pool; on a Dask cluster
of two local worker processes; there with the command killed in the middle and started again; there
with one worker killed at work. Every table must be that of the pool, and what was done before the
kill must not be done again.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from uav_ident_ros.offline.done import DONE_FILE
from uav_ident_ros.offline.flights_table import read_flights
from uav_ident_ros.simulation.cli import main as simulate

SOON = 0.4
"""Share of the flights that is done when something is killed."""


def make_bags(folder: Path, count: int, seconds: float) -> None:
    """Simulate flights of some length that differ in their noise."""
    for k in range(count):
        bag = folder / f"flight{k:03d}"
        if simulate(["--output", str(bag), "--duration", str(seconds), "--seed", str(k)]):
            raise SystemExit("simulate failed")


class Campaign:
    """Replays a folder of bags again and again."""

    def __init__(
        self,
        bags: Path,  # Folder of the bags
        folder: Path,  # Where the results go
    ) -> None:
        self._bags, self._folder = bags, folder
        self._parameters = next(bags.glob("*/identifier.yaml"))
        self._count = sum(1 for _ in bags.iterdir())

    def start(self, name: str, *more: str) -> subprocess.Popen[str]:
        """Start `replay` over all bags."""
        command = [sys.executable, "-m", "uav_ident_ros.offline", str(self._bags)]
        command += ["--params-file", str(self._parameters), "--output", str(self._folder / name)]
        return subprocess.Popen(
            [*command, *more], stdout=subprocess.PIPE, text=True, start_new_session=True
        )

    def done(self, name: str) -> dict[str, int]:
        """Return the flights that are done, and when their last file was written, ns."""
        files = (self._folder / name).glob(f"*/{DONE_FILE}")
        return {file.parent.name: file.stat().st_mtime_ns for file in files}

    def wait_until_many_are_done(self, name: str, process: subprocess.Popen[str]) -> None:
        """Return when a good part is done, or all of it."""
        while process.poll() is None and len(self.done(name)) < SOON * self._count:
            time.sleep(0.02)

    def table(self, name: str) -> list[str]:
        """Return the rows of the table, in an order of their own."""
        return sorted(map(str, read_flights(self._folder / name)))

    def problems(self, name: str) -> Iterator[str]:
        """Yield how a run differs from that of the pool."""
        if len(self.done(name)) != self._count:
            yield f"{name}: {len(self.done(name))} flights are done, {self._count} are there"
        if self.table(name) != self.table("pool"):
            yield f"{name}: another table than that of the pool"

    def killed(self, scheduler: str) -> Iterator[str]:
        """Kill the command in the middle, and start it again."""
        name = "killed"
        process = self.start(name, "--scheduler", scheduler)
        self.wait_until_many_are_done(name, process)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        time.sleep(2.0)  # what the workers have begun ends
        before = self.done(name)
        said, _ = self.start(name, "--scheduler", scheduler).communicate()
        if f"; {len(before)} of them as replayed before" not in said:
            yield f"{name}: {len(before)} were done, and it said: {said.splitlines()[-1]}"
        again = sum(self.done(name)[flight] != written for flight, written in before.items())
        print(f"{name}: {len(before)} of {self._count} were done")
        if again:
            yield f"{name}: {again} were done twice"

    def worker_killed(self, cluster: object, scheduler: str) -> Iterator[str]:
        """Kill a worker at work."""
        from distributed import Client

        name = "worker killed"
        process = self.start(name, "--scheduler", scheduler)
        self.wait_until_many_are_done(name, process)
        with Client(scheduler) as client:
            busy = [a for a, tasks in client.processing().items() if tasks]
        workers = cluster.workers.values()  # type: ignore[attr-defined]
        worker = next((w for w in workers if w.worker_address in busy), None)
        if worker is None:
            yield f"{name}: none was at work"
        else:
            os.kill(worker.process.pid, signal.SIGKILL)
        process.communicate()


def run(count: int, seconds: float, folder: Path) -> list[str]:
    """Run the campaign in an empty folder; return what went wrong."""
    from distributed import LocalCluster

    bags = folder / "bags"
    make_bags(bags, count, seconds)
    campaign = Campaign(bags, folder)
    problems: list[str] = []
    begun = time.monotonic()

    def ended(name: str, *found: str) -> None:
        nonlocal begun
        problems.extend([*found, *campaign.problems(name)])
        print(f"{name}: {count} flights in {time.monotonic() - begun:.0f} s", flush=True)
        begun = time.monotonic()

    campaign.start("pool", "--jobs", "2").communicate()
    ended("pool")
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        scheduler = cluster.scheduler_address
        campaign.start("cluster", "--scheduler", scheduler).communicate()
        ended("cluster")
        ended("killed", *campaign.killed(scheduler))
        ended("worker killed", *campaign.worker_killed(cluster, scheduler))
    return problems


def main() -> None:
    """Run it and print what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bags", type=int, default=200, help="number of flights (200)")
    parser.add_argument("--seconds", type=float, default=8.0, help="length of a flight, s (8)")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp())
    try:
        problems = run(options.bags, options.seconds, folder)
    finally:
        shutil.rmtree(folder)
    print("\n".join(problems) or "the same table every time, nothing done twice")
    raise SystemExit(bool(problems))


if __name__ == "__main__":
    main()
