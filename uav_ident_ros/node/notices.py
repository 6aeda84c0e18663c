# SPDX-License-Identifier: Apache-2.0
"""Throttled log lines, and the handling of unforeseen errors."""

import re
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import rclpy

REPEAT_AFTER = 5.0
"""Shortest interval of one notice, s."""


class Throttle:
    """Logs a notice at once, and repetitions at most every `REPEAT_AFTER`, with their count."""

    def __init__(
        self,
        log: Callable[[str], object],  # Writes a line, ``logger.warning`` for example
        # Monotonic seconds; not the node's clock, which may stand still
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._log, self._clock = log, clock
        self._logged: dict[tuple[str, ...], float] = {}
        self._kept: Counter[tuple[str, ...]] = Counter()

    def notice(self, key: tuple[str, ...], line: str) -> None:
        """Log a notice, or count it if one of the same key, (topic, reason), was logged lately."""
        now = self._clock()
        if key in self._logged and now - self._logged[key] < REPEAT_AFTER:
            self._kept[key] += 1
            return
        self._logged[key] = now
        kept = self._kept.pop(key, 0)
        self._log(f"{line} ({kept} more like it before)" if kept else line)


def without_numbers(line: str) -> str:
    """Return a line with its numbers masked, to compare lines."""
    return re.sub(r"\d+(\.\d+)?", "#", line)


def without_sources(message: str) -> str:
    """Return an error message of ROS in one line, without places in its sources."""
    return " ".join(re.sub(r", at \S+:\d+", "", message).split())


class Guard:
    """Logs the errors of blocks and callbacks, which would end the node."""

    def __init__(self, errors: Throttle) -> None:
        self._errors = errors
        self.count = 0  # Errors so far
        self.problem = ""  # The last one, in a sentence; empty if there was none

    @contextmanager
    def __call__(self, what: str, then: Callable[[], object] = lambda: None) -> Iterator[None]:
        """Log an error in a block, or in a decorated callback, and call `then`."""
        try:
            yield
        except Exception as error:
            self.note(what, error)
            then()

    def note(self, what: str, error: Exception) -> None:
        """Log the error in `what` that is being handled; raise it after the shutdown of ROS."""
        if not rclpy.ok():
            raise error
        self.count += 1
        self.problem = f"internal error in '{what}': {type(error).__name__}: {error}"
        where = traceback.format_exc()
        line = f"{self.problem}. The node goes on; please report this:\n{where}"
        self._errors.notice((what, type(error).__name__), line)
