# SPDX-License-Identifier: Apache-2.0
"""The last resort: an error that nobody foresaw is told, and does not end a node in flight."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import rclpy

from uav_ident_ros.node.notices import Throttle

P = ParamSpec("P")
R = TypeVar("R")


class Guard:
    """Wraps callbacks so that their errors are told instead of ending the node.

    Attributes
    ----------
    count : int
        Errors so far.
    problem : str
        The last one, in a sentence; empty if there was none.
    """

    def __init__(
        self,
        errors: Throttle,  # Takes the errors, with where they arose
    ) -> None:
        self._errors = errors
        self.count = 0
        self.problem = ""

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
