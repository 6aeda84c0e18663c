# SPDX-License-Identifier: Apache-2.0
"""Stamped values of the last seconds, to be asked for by time."""

from collections import deque
from typing import Generic, TypeVar

LENGTH = 128
"""Values that are kept: six seconds of coefficients, one of a fast reference."""

Value = TypeVar("Value")


class History(Generic[Value]):
    """The newest values of a topic by their stamps."""

    def __init__(self) -> None:
        self._items: deque[tuple[int, Value]] = deque(maxlen=LENGTH)

    def add(self, t_ns: int, value: Value) -> None:
        """Add a value: it hides what came before with a later stamp, as after a new start."""
        self._items.append((t_ns, value))

    def at(self, t_ns: int) -> Value | None:
        """Newest value stamped at or before `t_ns`; None if there is none."""
        for stamp, value in reversed(self._items):
            if stamp <= t_ns:
                return value
        return None
