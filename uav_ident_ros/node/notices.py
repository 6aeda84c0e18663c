# SPDX-License-Identifier: Apache-2.0
"""What the node says in its log: often enough to be seen, never a flood."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable

REPEAT_AFTER = 5.0
"""Seconds until the same notice may be given again."""


class Throttle:
    """Passes a repeated notice on at once, then at most every few seconds, with its count."""

    def __init__(
        self,
        say: Callable[[str], object],  # Takes the line, ``logger.warning`` for example
        repeat_after: float = REPEAT_AFTER,  # Seconds until the same notice may be given again
        # Monotonic seconds; not the node's clock, which may stand still
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._say = say
        self._repeat_after = repeat_after
        self._clock = clock
        self._said: dict[tuple[str, ...], float] = {}
        self._kept: Counter[tuple[str, ...]] = Counter()

    def notice(
        self,
        key: tuple[str, ...],  # What counts as the same notice, such as (topic, reason)
        line: Callable[[], str],  # Makes the line; called only if it is said
    ) -> None:
        """Give the notice `key`, or count it."""
        now = self._clock()
        last = self._said.get(key)
        if last is not None and now - last < self._repeat_after:
            self._kept[key] += 1
            return
        self._said[key] = now
        kept = self._kept.pop(key, 0)
        self._say(f"{line()} ({kept} more like it before)" if kept else line())


class OnChange:
    """Tells a change from more of the same; other numbers in a line are not a change."""

    def __init__(self) -> None:
        self._last = ""

    def changed(self, line: str) -> bool:
        """Whether `line` says something else than the last one."""
        masked = re.sub(r"\d+(\.\d+)?", "#", line)
        before, self._last = self._last, masked
        return masked != before


def without_sources(message: str) -> str:
    """Return what ROS says in one line, without where in its own sources it arose."""
    return " ".join(re.sub(r", at \S+:\d+", "", message).split())
