# SPDX-License-Identifier: Apache-2.0
"""Several replays at once, each in a process of its own: whatever ends one leaves the others."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from uav_ident_ros.bags.reading import Message
from uav_ident_ros.offline.job import NO_RESULT, Job, Outcome, replay
from uav_ident_ros.offline.progress import bar

STEPS = 200
"""A process says so many times how far it is."""

Told = Callable[[float], None]
"""Hears of progress: the share of one job done since the last call."""


def replay_all(jobs: Sequence[Job], workers: int) -> list[Outcome]:
    """Do jobs in parallel; the outcomes are in the order of the jobs.

    Parameters
    ----------
    jobs : sequence of Job
        The jobs; their folders must differ.
    workers : int
        Processes at a time.
    """
    shown = bar(total=len(jobs), unit=" replays", bar_format="{l_bar}{bar}| {elapsed}<{remaining}")
    told: Told = (lambda share: None) if shown is None else shown.update
    processes = _Processes()
    # Started by a thread below, it would let Ctrl-C through to the processes of that thread.
    resource_tracker.ensure_running()
    pool = ThreadPoolExecutor(max(1, min(workers, len(jobs))), initializer=_leave_interrupts)
    try:
        return list(pool.map(lambda job: processes.replay(job, told), jobs))
    except BaseException:
        processes.stop()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        if shown is not None:
            shown.close()


def _leave_interrupts() -> None:
    """Leave Ctrl-C to the main thread, here and in the processes that this thread starts."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


class _Processes:
    """Processes under way; each does one job."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._alive: set[BaseProcess] = set()
        self._stopped = False

    def stop(self) -> None:
        """End every process and start no more."""
        self._stopped = True
        for process in list(self._alive):
            process.terminate()

    def _is_stopped(self) -> bool:
        """Whether `stop` has been called, by another thread."""
        return self._stopped

    def replay(self, job: Job, told: Told) -> Outcome:
        """Do a job in a process of its own and wait for it."""
        if self._is_stopped():
            return Outcome(job, NO_RESULT, ("interrupted",))
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_work, args=(job, sender), daemon=True)
        process.start()
        sender.close()
        self._alive.add(process)
        if self._is_stopped():  # meanwhile
            process.terminate()
        done = 0.0
        try:
            while True:
                word = receiver.recv()
                if isinstance(word, Outcome):
                    return word
                told(word - done)
                done = word
        except EOFError:
            process.join()
            return Outcome(job, NO_RESULT, (_how_it_ended(job, process.exitcode),))
        finally:
            told(1.0 - done)
            process.join()
            self._alive.discard(process)


def _how_it_ended(job: Job, exitcode: int | None) -> str:
    """Say why a process left no outcome."""
    if exitcode is not None and exitcode < 0:
        return f"bag '{job.bag}': its process was ended by {signal.Signals(-exitcode).name}"
    return f"bag '{job.bag}': its process ended with status {exitcode}"


def _work(job: Job, sender: Connection) -> None:
    """Do a job and send how far it is, then its outcome."""

    def progress(messages: Iterable[Message], total: int) -> Iterator[Message]:
        every = max(1, total // STEPS)
        for count, message in enumerate(messages):
            if count % every == 0:
                sender.send(count / total)
            yield message

    try:
        outcome = replay(job, progress)
    except Exception:
        # A fault of this program: the rest of the bags can do without this one.
        traceback.print_exc()
        outcome = Outcome(job, NO_RESULT, (f"bag '{job.bag}': {_last_line()}",))
    sender.send(outcome)
    sender.close()


def _last_line() -> str:
    return traceback.format_exc().strip().splitlines()[-1]
