# SPDX-License-Identifier: Apache-2.0
"""Several replays at once: on this machine's processes, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import resource_tracker

from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.offline.job import REFUSALS, Job, Outcome, replay
from uav_ident_ros.offline.journal import identity_of
from uav_ident_ros.offline.progress import bar
from uav_ident_ros.offline.status import NO_RESULT

ATTEMPTS = 3
"""How often a flight is begun whose worker of the cluster has gone: a bag that ends every worker
must not end all of them."""

Done = Callable[[Outcome], None]
"""Takes an outcome as soon as there is one."""


def replay_all(
    jobs: Sequence[Job],  # The jobs; their folders must differ
    workers: int,  # Processes at a time on this machine
    # Address of a Dask scheduler whose workers do the jobs instead; they need the same paths
    scheduler: str = "",
    # Takes each outcome as soon as there is one, in this process
    done: Done = lambda outcome: None,
) -> list[Outcome]:
    """Do jobs in parallel; the outcomes are in the order of the jobs.

    Raises
    ------
    BagError
        If the scheduler does not answer, or Dask is missing.
    """
    shown = bar(total=len(jobs), unit=" replays")
    outcomes: dict[int, Outcome] = {}

    def take(k: int, outcome: Outcome) -> None:
        outcomes[k] = outcome
        done(outcome)
        if shown is not None:
            shown.update()
            shown.refresh()

    try:
        if scheduler:
            with _cluster(scheduler) as executor:
                for k, outcome in _do(executor, dict(enumerate(jobs))):
                    take(k, outcome or _lost(jobs[k]))
        else:
            _do_here(jobs, workers, take)
    finally:
        if shown is not None:
            shown.close()
    return [outcomes[k] for k in range(len(jobs))]


def _do_here(jobs: Sequence[Job], workers: int, take: Callable[[int, Outcome], None]) -> None:
    """Do jobs in processes of this machine.

    The end of one process breaks the pool. What it leaves is done one by one, each in a pool of its
    own: then it is known which flight ends its process, and it ends no other.
    """
    left: dict[int, Job] = {}
    with _pool(max(1, min(workers, len(jobs)))) as executor:
        for k, outcome in _do(executor, dict(enumerate(jobs))):
            if outcome is None:
                left[k] = jobs[k]
            else:
                take(k, outcome)
    for k, job in left.items():
        with _pool(1) as executor:
            for _, outcome in _do(executor, {k: job}):
                take(k, outcome or _lost(job))


def _do(executor: Executor, jobs: dict[int, Job]) -> Iterator[tuple[int, Outcome | None]]:
    """Yield outcomes as they come; None for a job whose process has gone."""
    # The processes must not hear of Ctrl-C: this one ends them.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        futures = {executor.submit(work, job): k for k, job in jobs.items()}
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    for future in as_completed(futures):
        error = future.exception()
        if isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker":
            yield futures[future], None
        else:
            yield futures[future], future.result()


def _lost(job: Job) -> Outcome:
    return Outcome(job, NO_RESULT, (f"bag '{job.bag}': the process that read it was ended",))


@contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """Open a pool of processes; on the way out by an exception they are ended at once."""
    # Started by the pool it would let Ctrl-C through.
    resource_tracker.ensure_running()
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    try:
        yield pool
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    """Connect to a Dask scheduler."""
    try:
        from distributed import Client
    except ImportError:
        raise BagError("--scheduler needs Dask: pip install distributed") from None
    try:
        client = Client(scheduler)
    except (OSError, ValueError) as error:
        raise BagError(f"no Dask scheduler answers at '{scheduler}': {error}") from None
    with client, client.get_executor(pure=False, retries=ATTEMPTS) as executor:
        yield executor


def work(job: Job) -> Outcome:
    """Do a job, unless it was done before with the same bag and settings; never raises."""
    try:
        identity = identity_of(job)
    except REFUSALS:
        identity = ""  # the replay says what is wrong
    if identity and identity == job.known:
        return Outcome(job, NO_RESULT, identity=identity, kept=True)
    try:
        return replace(replay(job), identity=identity)
    except Exception:
        # A fault of this program: the rest of the bags can do without this one.
        traceback.print_exc()
        last = traceback.format_exc().strip().splitlines()[-1]
        return Outcome(job, NO_RESULT, (f"bag '{job.bag}': {last}",))
