# SPDX-License-Identifier: Apache-2.0
"""Several replays at once: on this machine's processes, or on a Dask cluster."""

import multiprocessing
import signal
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import resource_tracker

from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.offline.done import forget, identity_of, recalled, remember
from uav_ident_ros.offline.job import REFUSALS, Job, Outcome, replay
from uav_ident_ros.offline.progress import bar
from uav_ident_ros.offline.status import NO_RESULT

ATTEMPTS = 3
"""How often a flight is begun whose worker of the cluster has gone: a bag that ends every worker
must not end all of them."""


def replay_all(
    jobs: Sequence[Job],  # The jobs; their folders must differ
    workers: int,  # Processes at a time on this machine
    # Address of a Dask scheduler whose workers do the jobs instead; they need the same paths
    scheduler: str = "",
) -> list[Outcome]:
    """Do jobs in parallel; the outcomes are in the order of the jobs.

    Raises
    ------
    BagError
        If the scheduler does not answer, or Dask is missing.
    """
    outcomes: dict[int, Outcome] = {}
    with bar(total=len(jobs), unit=" replays") as shown:
        for k, outcome in _there(jobs, scheduler) if scheduler else _here(jobs, workers):
            lost = f"bag '{jobs[k].bag}': the process that read it was ended"
            outcomes[k] = outcome or Outcome(jobs[k], NO_RESULT, (lost,))
            shown.update()
            shown.refresh()
    return [outcomes[k] for k in range(len(jobs))]


def _there(jobs: Sequence[Job], scheduler: str) -> Iterator[tuple[int, Outcome | None]]:
    """Yield the outcomes of a cluster as they come; None for a job whose workers have gone."""
    with _cluster(scheduler) as executor:
        yield from _do(executor, dict(enumerate(jobs)))


def _here(jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Outcome | None]]:
    """Yield the outcomes of processes of this machine; None for a job whose process has gone.

    The end of one process breaks the pool. What it leaves is done one by one, each in a pool of its
    own: then it is known which flight ends its process, and it ends no other.
    """
    left: list[int] = []
    with _pool(max(1, min(workers, len(jobs)))) as executor:
        for k, outcome in _do(executor, dict(enumerate(jobs))):
            if outcome is None:
                left.append(k)
            else:
                yield k, outcome
    for k in left:
        with _pool(1) as executor:
            yield from _do(executor, {k: jobs[k]})


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
        try:
            identity = identity_of(job)
        except REFUSALS:
            return replay(job)  # which says what is wrong
        outcome = None if job.again else recalled(job, identity)
        if outcome is None:
            forget(job)
            outcome = replace(replay(job), identity=identity)
            remember(outcome)
        return outcome
    except REFUSALS as error:
        return Outcome(job, NO_RESULT, (str(error),))
    except Exception:
        # A fault of this program: the rest of the bags can do without this one.
        traceback.print_exc()
        last = traceback.format_exc().strip().splitlines()[-1]
        return Outcome(job, NO_RESULT, (f"bag '{job.bag}': {last}",))
