# SPDX-License-Identifier: Apache-2.0
"""What the node says in its log: often enough to be seen, never a flood; unforeseen errors, too."""

import functools
import re
import time
import traceback
from collections import Counter
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import rclpy

REPEAT_AFTER = 5.0
"""Seconds until the same notice may be given again."""


class Throttle:
    """Passes a repeated notice on at once, then at most every few seconds, with its count."""

    def __init__(
        self,
        log: Callable[[str], object],  # Takes the line, ``logger.warning`` for example
        # Monotonic seconds; not the node's clock, which may stand still
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._log, self._clock = log, clock
        self._logged: dict[tuple[str, ...], float] = {}
        self._kept: Counter[tuple[str, ...]] = Counter()

    def notice(self, key: tuple[str, ...], line: str) -> None:
        """Give a notice, or count it; what has the same key, (topic, reason), is the same one."""
        now = self._clock()
        if key in self._logged and now - self._logged[key] < REPEAT_AFTER:
            self._kept[key] += 1
            return
        self._logged[key] = now
        kept = self._kept.pop(key, 0)
        self._log(f"{line} ({kept} more like it before)" if kept else line)


def without_numbers(line: str) -> str:
    """Return a line by which a change is told from the same with other numbers."""
    return re.sub(r"\d+(\.\d+)?", "#", line)


def without_sources(message: str) -> str:
    """Return what ROS says in one line, without where in its own sources it arose."""
    return " ".join(re.sub(r", at \S+:\d+", "", message).split())


P = ParamSpec("P")
R = TypeVar("R")


class Guard:
    """Wraps callbacks so that their errors are told instead of ending the node."""

    def __init__(self, errors: Throttle) -> None:
        self._errors = errors
        self.count = 0  # Errors so far
        self.problem = ""  # The last one, in a sentence; empty if there was none

    def __call__(
        self, callback: Callable[P, R], otherwise: Callable[..., R] | None = None
    ) -> Callable[P, R | None]:
        """Return `callback`, guarded: after a failure `otherwise` is called in its place."""

        @functools.wraps(callback)
        def guarded(*args: P.args, **kwargs: P.kwargs) -> R | None:
            try:
                return callback(*args, **kwargs)
            except Exception as error:
                self.note(callback.__name__.strip("_"), error)
            return None if otherwise is None else otherwise(*args, **kwargs)

        return guarded

    def note(self, what: str, error: Exception) -> None:
        """Tell of an error in `what` while it is handled; at the end of the program it is none."""
        if not rclpy.ok():
            raise error
        self.count += 1
        self.problem = f"internal error in '{what}': {type(error).__name__}: {error}"
        where = traceback.format_exc()
        line = f"{self.problem}. The node goes on; please report this:\n{where}"
        self._errors.notice((what, type(error).__name__), line)
