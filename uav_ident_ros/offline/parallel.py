# SPDX-License-Identifier: Apache-2.0
"""Many replays: in processes of this machine or on a Dask cluster, and none twice.

Two replays are identical if the bag's bytes, the settings and the package's version are. The file
with their hashes is written last, so that an interrupted replay is repeated.
"""

import hashlib
import json
import multiprocessing
import signal
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path

import uav_ident_ros
from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.bags.writing import write_file
from uav_ident_ros.offline import NO_RESULT
from uav_ident_ros.offline.find import RESULT_FILE, bag_files, name_size_hash
from uav_ident_ros.offline.job import REPLAY_REFUSALS, Job, Outcome, optional, replay, reserved
from uav_ident_ros.offline.run import Bar

DONE_FILE = "replayed.json"

ATTEMPTS = 3
"""Attempts at a flight whose worker of the cluster has ended: a bag that ends every worker must not
end all of them."""

ENDING = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
"""Signals that end the command, and all its processes."""


def replay_all(
    jobs: Sequence[Job],  # The jobs; their folders must differ
    workers: int,  # Number of processes on this machine
    # Address of a Dask scheduler whose workers run the jobs instead; they need the same paths
    scheduler: str = "",
) -> list[Outcome]:
    """Run jobs in parallel, outcomes in their order; raises `BagError` without the scheduler.

    The end of one process breaks a pool of this machine. The remaining jobs run one by one, each in
    a pool of its own. A flight that ends its process then affects no other.
    """
    outcomes: dict[Path, Outcome] = {}
    with Bar(total=len(jobs), unit=" replays") as shown:

        def run(executor: Executor, jobs: Sequence[Job]) -> None:
            for outcome in _finished(executor, jobs):
                outcomes[outcome.job.folder] = outcome
                shown.update()

        with _cluster(scheduler) if scheduler else _pool(min(workers, len(jobs))) as executor:
            run(executor, jobs)
        left = [] if scheduler else [job for job in jobs if job.folder not in outcomes]
        for job in left:
            with _pool(1) as executor:
                run(executor, [job])
    for job in jobs:
        lost = f"bag '{job.bag}': the process that read it was ended"
        outcomes.setdefault(job.folder, Outcome(job, NO_RESULT, (lost,)))
    return [outcomes[job.folder] for job in jobs]


def _finished(executor: Executor, jobs: Sequence[Job]) -> Iterator[Outcome]:
    """Run jobs; yield their outcomes, but those of jobs whose process has ended."""
    # Ctrl-C must not reach the processes: this one ends them, and not while it starts one.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        futures = [executor.submit(work, job) for job in jobs]
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    for future in as_completed(futures):
        error = future.exception()
        if not (isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker"):
            yield future.result()


@contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    """Open the workers of a cluster."""
    try:
        client = optional("distributed").Client(scheduler)
    except (OSError, ValueError) as error:
        raise BagError(f"no Dask scheduler answers at '{scheduler}': {error}") from None
    with client, client.get_executor(pure=False, retries=ATTEMPTS) as executor:
        yield executor


@contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """Open a pool of processes; an exception ends them at once."""
    # Started by the pool, the tracker would receive Ctrl-C.
    resource_tracker.ensure_running()
    # They inherit the blocked signals, but must end by SIGTERM.
    ready = partial(signal.pthread_sigmask, signal.SIG_UNBLOCK, ENDING - {signal.SIGINT})
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), ready)
    try:
        yield pool
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def work(job: Job) -> Outcome:
    """Run a job, unless it was run before with the same bag and settings; never raises."""
    done = job.folder / DONE_FILE
    try:
        try:
            identity = identity_of(job)
        except REPLAY_REFUSALS:
            return replay(job)  # its outcome has the problem
        with reserved(job.folder):
            outcome = None if job.again else _earlier_outcome(job, identity)
            if outcome is None:
                write_file(done, "")  # invalid until the new results are written
                outcome = replace(replay(job), identity=identity)
                keys = ("identity", "status", "warnings")
                write_file(done, json.dumps({key: getattr(outcome, key) for key in keys}) + "\n")
            return outcome
    except REPLAY_REFUSALS as error:
        return Outcome(job, NO_RESULT, (str(error),))
    except Exception:
        # A fault of this program must not prevent the replay of the other bags.
        traceback.print_exc()
        last = traceback.format_exc().strip().splitlines()[-1]
        return Outcome(job, NO_RESULT, (f"bag '{job.bag}': {last}",))


def _earlier_outcome(job: Job, identity: str) -> Outcome | None:
    """Return the earlier outcome of a job; None if there is none of this identity."""
    try:
        entry = json.loads((job.folder / DONE_FILE).read_text(encoding="utf-8"))
        if entry["identity"] != identity:
            return None
        status, warnings, summary = entry["status"], tuple(entry["warnings"]), {}
        if status != NO_RESULT:
            summary = json.loads((job.folder / RESULT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Outcome(job, status, warnings, summary=summary, identity=identity, kept=True)


def identity_of(job: Job) -> str:
    """Return the hashes of a job's bag and settings, ``BAG:SETTINGS``; raises `REPLAY_REFUSALS`."""
    values = job.parameters
    initial = values.get("initial_coefficients_file")
    settings = {
        "version": uav_ident_ros.__version__,
        "values": values,
        "initial": name_size_hash(Path(str(initial))) if initial else None,
        "node": job.node,
        "topics": dict(job.topics),
        "plot": job.plot,
        "report": job.report,
    }
    parts = (
        json.dumps(part, sort_keys=True, default=repr) for part in (bag_files(job.bag), settings)
    )
    return ":".join(hashlib.sha256(part.encode()).hexdigest() for part in parts)
