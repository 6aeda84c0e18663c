# SPDX-License-Identifier: Apache-2.0
"""Which stamps a stream of samples is allowed to have."""

from __future__ import annotations

from enum import Enum

AGREEING_SAMPLES = 5
"""So many consecutive samples on a new time base are believed: one outlier is not."""


class Stamp(Enum):
    """Verdict on one stamp."""

    GOOD = "good"
    OUTLYING = "outlying"
    NEW_BASE = "new base"


class StampGuard:
    """Tells an outlying stamp from a new time base.

    Parameters
    ----------
    jump_ns : int
        Distance from the newest stamp beyond which a stamp is outlying, ns.
    """

    def __init__(self, jump_ns: int) -> None:
        self._jump_ns = jump_ns
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next stamp starts a new one."""
        self.newest: int | None = None
        self._candidate: int = 0
        self._agreeing: int = 0

    def check(self, t_ns: int) -> Stamp:
        """Judge the stamp `t_ns`; on NEW_BASE the stream has moved to it."""
        if self.newest is None or abs(t_ns - self.newest) <= self._jump_ns:
            self.newest = t_ns if self.newest is None else max(self.newest, t_ns)
            self._agreeing = 0
            return Stamp.GOOD
        agrees = self._agreeing and 0 < t_ns - self._candidate <= self._jump_ns
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._candidate = t_ns
        if self._agreeing < AGREEING_SAMPLES:
            return Stamp.OUTLYING
        self.newest = t_ns
        self._agreeing = 0
        return Stamp.NEW_BASE
