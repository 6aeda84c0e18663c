# SPDX-License-Identifier: Apache-2.0
"""What the node says in its log: often enough to be seen, never a flood; unforeseen errors, too."""

import functools
import re
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ParamSpec, TypeVar

import rclpy

REPEAT_AFTER = 5.0
"""Seconds until the same notice may be given again."""


@dataclass
class Throttle:
    """Passes a repeated notice on at once, then at most every few seconds, with its count."""

    log: Callable[[str], object]  # Takes the line, ``logger.warning`` for example
    repeat_after: float = REPEAT_AFTER  # Seconds until the same notice may be given again
    # Monotonic seconds; not the node's clock, which may stand still
    clock: Callable[[], float] = time.monotonic
    _logged: dict[tuple[str, ...], float] = field(default_factory=dict)
    _kept: Counter[tuple[str, ...]] = field(default_factory=Counter)

    def notice(
        self,
        key: tuple[str, ...],  # What counts as the same notice, such as (topic, reason)
        line: Callable[[], str],  # Makes the line; called only if it is said
    ) -> None:
        """Give the notice `key`, or count it."""
        now = self.clock()
        last = self._logged.get(key)
        if last is not None and now - last < self.repeat_after:
            self._kept[key] += 1
            return
        self._logged[key] = now
        kept = self._kept.pop(key, 0)
        self.log(f"{line()} ({kept} more like it before)" if kept else line())


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


P = ParamSpec("P")
R = TypeVar("R")


class Guard:
    """Wraps callbacks so that their errors are told instead of ending the node."""

    def __init__(
        self,
        errors: Throttle,  # Takes the errors, with where they arose
    ) -> None:
        self._errors = errors
        self.count = 0  # Errors so far
        self.problem = ""  # The last one, in a sentence; empty if there was none

    def __call__(
        self,
        callback: Callable[P, R],  # What may fail
        # Called with the same arguments after a failure; its value is returned
        otherwise: Callable[..., R] | None = None,
    ) -> Callable[P, R | None]:
        """Return `callback`, guarded."""

        @functools.wraps(callback)
        def guarded(*args: P.args, **kwargs: P.kwargs) -> R | None:
            try:
                return callback(*args, **kwargs)
            except Exception as error:
                if not rclpy.ok():
                    raise  # the end of the program: no error
                self._note(callback, error)
            return None if otherwise is None else otherwise(*args, **kwargs)

        return guarded

    def _note(self, callback: Callable[..., object], error: Exception) -> None:
        name = getattr(callback, "__name__", "callback").strip("_")
        self.count += 1
        self.problem = f"internal error in '{name}': {type(error).__name__}: {error}"
        where = traceback.format_exc()
        line = f"{self.problem}. The node goes on; please report this:\n{where}"
        self._errors.notice((name, type(error).__name__), lambda: line)
