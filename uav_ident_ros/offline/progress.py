# SPDX-License-Identifier: Apache-2.0
"""How far a replay is: a bar on a terminal, a line now and then where there is none."""

import sys
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
    """Return a tqdm bar on the error stream."""
    from tqdm import tqdm

    tqdm.monitor_interval = 0  # its thread would take Ctrl-C where this one holds it back
    pace = {"mininterval": 0.0}
    if not sys.stderr.isatty():
        pace = {"mininterval": LINE_EVERY, "delay": LINE_EVERY}
    return tqdm(leave=False, miniters=0, **pace, **options)


class Progress:
    """Progress over all phases with the time that is left; a context manager."""

    def __init__(
        self,
        shown: bool = True,  # Silent if not: the work of one process among many
    ) -> None:
        form = "{desc:<9} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        self._bar = bar(total=1.0, bar_format=form, disable=not shown)

    def __enter__(self) -> "Progress":
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the terminal as it was."""
        self._bar.close()

    def enter(self, phase: str) -> None:
        """Begin a phase, one of `SHARES`; all before it are done."""
        phases = list(SHARES)
        self._bar.set_description_str(phase, refresh=False)
        self._reach(sum(SHARES[name] for name in phases[: phases.index(phase)]))

    def messages(self, messages: Iterable[Message], total: int) -> Iterator[Message]:
        """Pass messages on and show how many of the total have been read."""
        every = max(1, total // STEPS)
        for count, message in enumerate(messages):
            if count % every == 0:
                self._reach(SHARES["reading"] * min(count / total, 1.0))
            yield message

    def _reach(self, share: float) -> None:
        self._bar.update(max(share - self._bar.n, 0.0))
