# SPDX-License-Identifier: Apache-2.0
"""Judges the node's clock: whether /clock arrives, moves, and moves in steps that are usable."""

from __future__ import annotations

import time

STANDS_AFTER = 2.0
"""Seconds without progress of /clock that are worth a word."""

STEPS = 3
"""Jumps in a row that are no accident but how /clock moves."""


class ClockWatch:
    """Watches the node's clock under simulated time."""

    def __init__(
        self,
        time_jump: float,  # Step of /clock from which on it counts as a jump, s
        # Ticks per second: jumps in a row have less than a second of ticks between them
        update_rate: float,
    ) -> None:
        self._time_jump = time_jump
        self._few_ticks = update_rate
        self._now_ns = 0
        self._moved = time.monotonic()
        self._jumps = 0
        self._step = 0.0
        self._ticks = 0

    def look(self, now_ns: int) -> None:
        """Note where the clock is; to be called about once a second."""
        if now_ns != self._now_ns:
            self._now_ns, self._moved = now_ns, time.monotonic()

    def jumped(self, seconds: float, ticks: int) -> None:
        """Note a jump by `seconds` after so many ticks since the start."""
        in_row = seconds > 0.0 and ticks - self._ticks < self._few_ticks
        self._jumps = self._jumps + 1 if in_row else 1
        self._step, self._ticks = seconds, ticks

    def fault(self, ticks: int) -> str:
        """Return why the filters restart for ever; empty if they do not."""
        if self._jumps < STEPS or ticks - self._ticks >= self._few_ticks:
            return ""
        return (
            f"/clock moves in steps of {self._step:.3g} s, and each of 'time_jump' "
            f"({self._time_jump:g} s) or more restarts the filters: publish it more often "
            "(ros2 bag play --clock 100)"
        )

    def silence(self) -> str:
        """Return what is wrong with /clock if it stands still; empty if it moves."""
        if time.monotonic() - self._moved <= STANDS_AFTER:
            return ""
        if self._now_ns == 0:
            return (
                "use_sim_time is true, but nothing arrives on /clock: play the bag with --clock, "
                "or set use_sim_time to false"
            )
        return "/clock stands still"
