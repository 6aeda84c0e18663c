# SPDX-License-Identifier: Apache-2.0
"""How far long work is: a bar on a terminal, a line now and then without one."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any

from uav_ident_ros.bags.reading import Message

SHARES = {"reading": 0.75, "scoring": 0.1, "measuring": 0.05, "writing": 0.05, "drawing": 0.05}
"""Phases of a replay, and their shares of its time as measured on flights of ten minutes."""

STEPS = 400
"""So many times the reading says how far it is."""

LINE_EVERY = 30.0
"""Time between two lines where there is no terminal, s."""


def bar(**options: Any) -> Any:
    """Return a tqdm bar on the error stream; None without a terminal or without tqdm."""
    if not sys.stderr.isatty():
        return None
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm(leave=False, **options)


class Progress:
    """Silent progress: what the work of one process among many tells."""

    def enter(self, phase: str) -> None:
        """Begin a phase, one of `SHARES`."""

    def messages(self, messages: Iterable[Message], total: int) -> Iterable[Message]:
        """Pass messages on; of `total` so many have been read."""
        return messages


class Shown(Progress):
    """Progress over all phases with the time that is left; a context manager."""

    def __init__(self) -> None:
        form = "{desc} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        self._bar = bar(total=1.0, bar_format=form)
        self._done = 0.0
        self._phase = ""
        self._begun = self._told = time.monotonic()

    def __enter__(self) -> Shown:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def enter(self, phase: str) -> None:
        """Begin a phase; all before it are done."""
        phases = list(SHARES)
        self._phase = phase
        if self._bar is not None:
            self._bar.set_description_str(f"{phase:<9}", refresh=False)
        self._show(sum(SHARES[name] for name in phases[: phases.index(phase)]))

    def messages(self, messages: Iterable[Message], total: int) -> Iterator[Message]:
        """Pass messages on and show how many have been read."""
        every = max(1, total // STEPS)
        for count, message in enumerate(messages):
            if count % every == 0:
                self._show(SHARES["reading"] * min(count / total, 1.0))
            yield message

    def _show(self, done: float) -> None:
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(max(done - self._done, 0.0))
            self._bar.refresh()
        elif now - self._told >= LINE_EVERY and done > 0.0:
            self._told = now
            left = (now - self._begun) * (1.0 - done) / done
            line = f"replay: {self._phase}, {100.0 * done:.0f} % done, about {left:.0f} s left"
            print(line, file=sys.stderr, flush=True)
        self._done = max(done, self._done)
