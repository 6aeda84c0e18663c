# SPDX-License-Identifier: Apache-2.0
"""How far long work is: a bar on a terminal, a line now and then without one."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any

from uav_ident_ros.bags.reading import Message

SHARES = {"reading": 0.75, "scoring": 0.1, "measuring": 0.05, "writing": 0.05, "drawing": 0.05}
"""Phases of a replay, and their shares of its time as measured on flights of ten minutes."""

STEPS = 400
"""So many times the reading says how far it is."""

LINE_EVERY = 30.0
"""Time between two lines where there is no terminal, s."""


def bar(**options: Any) -> Any:
    """Return a tqdm bar on the error stream, which shows nothing without a terminal."""
    from tqdm import tqdm

    tqdm.monitor_interval = 0  # its thread would take Ctrl-C where this one holds it back
    return tqdm(leave=False, disable=None, **options)


class Progress:
    """Progress over all phases with the time that is left."""

    def __init__(
        self,
        shown: bool = True,  # Silent if not: the work of one process among many
    ) -> None:
        self._shown = shown
        form = "{desc} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        self._bar = bar(total=1.0, bar_format=form) if shown else None
        self._done = 0.0
        self._phase = ""
        self._begun = self._told = time.monotonic()

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._bar is not None:
            self._bar.close()

    def enter(self, phase: str) -> None:
        """Begin a phase, one of `SHARES`; all before it are done."""
        phases = list(SHARES)
        self._phase = phase
        self._show(sum(SHARES[name] for name in phases[: phases.index(phase)]))

    def messages(self, messages: Iterable[Message], total: int) -> Iterator[Message]:
        """Pass messages on and show how many of the total have been read."""
        every = max(1, total // STEPS)
        for count, message in enumerate(messages):
            if count % every == 0:
                self._show(SHARES["reading"] * min(count / total, 1.0))
            yield message

    def _show(self, done: float) -> None:
        if self._bar is None:
            return
        now = time.monotonic()
        if not self._bar.disable:
            self._bar.set_description_str(f"{self._phase:<9}", refresh=False)
            self._bar.update(max(done - self._done, 0.0))
            self._bar.refresh()
        elif now - self._told >= LINE_EVERY and done > 0.0:
            self._told = now
            left = (now - self._begun) * (1.0 - done) / done
            line = f"replay: {self._phase}, {100.0 * done:.0f} % done, about {left:.0f} s left"
            print(line, file=sys.stderr, flush=True)
        self._done = max(done, self._done)
