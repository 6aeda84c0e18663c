# SPDX-License-Identifier: Apache-2.0
"""State of one identifier as received, in plain values: no ROS, no terminal."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from uav_ident_ros.client import Coefficients
from uav_ident_ros.identification.linearisation import Mode, level_modes
from uav_ident_ros.identification.structure import ROWS, FloatArray
from uav_ident_ros.messages.types import NS_PER_S

TREND_TIME = 10.0
"""Message time over which the trend of a coefficient is shown, s."""


STALE_AFTER = 1.5
"""Seconds without a tick after which the last one is stale: the slowest update rate is 1 Hz."""

STATES_WITHOUT_DATA = ("waiting", "fault")
"""States in which the last coefficients are out of date."""


@dataclass(frozen=True)
class Coefficient:
    """A coefficient as it was last published."""

    name: str  # ``pdot/da`` and so on
    # value, sigma: Value and standard deviation, SI; sigma is 0 for a fixed coefficient
    value: float
    sigma: float
    # Its values over the last `TREND_TIME`, oldest first, the newest included
    past: tuple[float, ...] = ()

    @property
    def t_ratio(self) -> float | None:
        """Magnitude of the value over sigma; None for a fixed coefficient."""
        return abs(self.value) / self.sigma if self.sigma > 0.0 else None

    @property
    def trend(self) -> int:
        """1 or -1 if it rose or fell by more than its standard deviation, else 0."""
        change = self.value - self.past[0] if self.past else 0.0
        if self.sigma == 0.0 or abs(change) <= self.sigma:
            return 0
        return 1 if change > 0.0 else -1


class _Status(dict[str, str]):
    """Values of a status by label; a label that the node's version does not have is a '?'."""

    def __missing__(self, label: str) -> str:
        return "?"


class WatchedNode:
    """Collects the outputs of one identifier."""

    def __init__(
        self,
        node: str,  # Full name of the node
        clock: Callable[[], float] = time.monotonic,  # Monotonic seconds, for ages
    ) -> None:
        self.node = node
        # State of the newest status on /diagnostics, and its reason
        self.state, self.reason = "", "no status on /diagnostics yet"
        self.values: Mapping[str, str] = {}  # Values of that status, by label
        self.newest: Coefficients | None = None  # Its newest coefficients
        self.ticks = 0  # Ticks received
        self.publishers = 1  # Nodes that publish under this name; more than one is a mistake
        self._clock, self._arrived = clock, -math.inf
        self._past: deque[tuple[int, FloatArray]] = deque()

    def take(self, new: Coefficients) -> None:
        """Add the content of one ~/coefficients_named message."""
        before, t_ns = self.newest, new.t_ns
        if before and (t_ns < before.t_ns or new.structure is not before.structure):
            self._past.clear()  # the node was restarted, with other data or another structure
        self.ticks += before is None or t_ns != before.t_ns
        self.newest, self._arrived = new, self._clock()
        self._past.append((t_ns, new.values))
        while t_ns - self._past[0][0] > TREND_TIME * NS_PER_S:
            self._past.popleft()

    def diagnosed(self, message: str, values: Mapping[str, str]) -> None:
        """Add one status: its message, and its values by label."""
        self.state, _, self.reason = message.partition(": ")
        self.values = _Status(values)

    def number(self, label: str) -> float | None:
        """Return a value of the status as a number; None if it is missing or not a number."""
        try:
            return float(self.values[label])
        except (KeyError, ValueError):
            return None

    @property
    def fresh(self) -> bool:
        """Whether ticks arrive now; the first message may be a latched one, of any age."""
        return self.ticks > 1 and self._clock() - self._arrived < STALE_AFTER

    @property
    def usable(self) -> bool:
        """Whether a controller may act on the coefficients now."""
        verdict = self.newest is not None and self.newest.usable
        return verdict and self.fresh and self.state not in STATES_WITHOUT_DATA

    def modes(self) -> list[Mode]:
        """Return the modes of the model in level flight; none without flow angles."""
        new = self.newest
        if new is None or new.flow is None:
            return []
        return level_modes(new.structure, new.values, new.sigma, new.flow.airspeed)

    def rows(self) -> dict[str, list[Coefficient]]:
        """Return the coefficients by the rows of the model, the moment equations first."""
        rows: dict[str, list[Coefficient]] = {row: [] for row in ROWS}
        if (new := self.newest) is None:
            return rows
        for name, index in new.structure.places.items():
            past = tuple(values[index] for _, values in self._past)
            coefficient = Coefficient(name, new.values[index], new.sigma[index], past)
            rows.setdefault(name.partition("/")[0], []).append(coefficient)
        return rows
