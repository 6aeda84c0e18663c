# SPDX-License-Identifier: Apache-2.0
"""What has been heard of one identifier, as plain values: no ROS, no terminal."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from uav_ident_ros.identification.linearisation import Mode, level_modes
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.messages.published import FIT_NAMES, USABLE_NAME
from uav_ident_ros.messages.types import NS_PER_S

AXIS_OF = {"pdot": "p", "qdot": "q", "rdot": "r"}
"""The moment equations, each with the rate that its fit is of."""

STATE = "state/"
NOT_COEFFICIENTS = ("fit/", "verdict/", STATE)
"""How the entries begin that are none."""

TREND_TIME = 10.0
"""Message time over which the trend of a coefficient is shown, s."""

TREND_POINTS = 20
"""Values kept of each coefficient over that time."""

SILENT_AFTER = 1.5
"""Seconds without a tick after which the last one is old: the slowest update rate is 1 Hz."""

STATES_WITHOUT_DATA = ("waiting", "fault")
"""State words under which the last coefficients are of the past."""

WAITING_FOR_STATUS = "no status on /diagnostics yet"


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
    def row(self) -> str:
        """Row of the model that it is in."""
        return self.name.partition("/")[0]

    @property
    def t_ratio(self) -> float | None:
        """How many standard deviations it is from zero; None for a fixed one."""
        return abs(self.value) / self.sigma if self.sigma > 0.0 else None

    @property
    def trend(self) -> int:
        """1 or -1 if it rose or fell by more than its standard deviation, else 0."""
        change = self.value - self.past[0] if self.past else 0.0
        if self.sigma == 0.0 or abs(change) <= self.sigma:
            return 0
        return 1 if change > 0.0 else -1


@dataclass(frozen=True)
class Status:
    """The newest status of the node on /diagnostics."""

    # state, reason: The state word, and why it is in it
    state: str = ""
    reason: str = WAITING_FOR_STATUS
    values: Mapping[str, str] = field(default_factory=dict)  # Everything beneath it, by label

    def number(self, label: str) -> float | None:
        """Value of a label as a number; None if it is missing or none."""
        try:
            return float(self.values[label])
        except (KeyError, ValueError):
            return None

    def group(self, name: str) -> dict[str, str]:
        """Values of a group, by their labels within it."""
        head = f"{name}: "
        return {k.removeprefix(head): v for k, v in self.values.items() if k.startswith(head)}

    def inputs(self) -> dict[str, dict[str, str]]:
        """Values of every input, by its stream: the groups that name a topic."""
        ending = ": topic"
        streams = [k.removesuffix(ending) for k in self.values if k.endswith(ending)]
        return {stream: self.group(stream) for stream in streams}


class Heard:
    """Gathers what one identifier publishes."""

    def __init__(
        self,
        node: str,  # Full name of the node
        clock: Callable[[], float] = time.monotonic,  # Monotonic seconds, for ages
    ) -> None:
        self.node = node
        self.status = Status()  # Its newest status
        self.ticks = 0  # Ticks heard
        self.publishers = 1  # Nodes that publish under this name; more than one is a mistake
        self._clock = clock
        self._arrived: float | None = None
        self._newest_ns: int | None = None
        self._entries: dict[str, float] = {}
        self._sigmas: tuple[float, ...] = ()
        self._past: deque[tuple[int, tuple[float, ...]]] = deque()

    # -- in --------------------------------------------------------------------------------

    def coefficients_named(
        self,
        t_ns: int,
        names: Sequence[str],
        values: Sequence[float],
        sigmas: Sequence[float],
    ) -> None:
        """Take the content of one ~/coefficients_named message, stamped `t_ns`."""
        if self._newest_ns is not None and (t_ns < self._newest_ns or [*names] != [*self._entries]):
            self._past.clear()  # it started again, from other data or with another structure
        self.ticks += t_ns != self._newest_ns
        self._newest_ns, self._arrived = t_ns, self._clock()
        self._entries, self._sigmas = dict(zip(names, values, strict=True)), tuple(sigmas)
        step_ns = round(TREND_TIME / TREND_POINTS * NS_PER_S)
        if not self._past or t_ns - self._past[-1][0] >= step_ns:
            self._past.append((t_ns, tuple(values)))
        while t_ns - self._past[0][0] > TREND_TIME * NS_PER_S:
            self._past.popleft()

    def diagnosed(self, message: str, values: Mapping[str, str]) -> None:
        """Take one status: its message, and its values by label."""
        state, _, reason = message.partition(": ")
        self.status = Status(state, reason, values)

    # -- out -------------------------------------------------------------------------------

    @property
    def tick(self) -> float | None:
        """Message time of the newest tick, s; None before the first."""
        return None if self._newest_ns is None else self._newest_ns / NS_PER_S

    @property
    def age(self) -> float:
        """Seconds since the newest tick arrived; inf before the first."""
        return math.inf if self._arrived is None else self._clock() - self._arrived

    @property
    def fresh(self) -> bool:
        """Whether ticks arrive now: the first message may be a latched one, of any age."""
        return self.ticks > 1 and self.age < SILENT_AFTER

    @property
    def usable(self) -> bool:
        """Whether a controller may act on the coefficients now."""
        verdict = self._entries.get(USABLE_NAME, 0.0) >= 1.0
        return verdict and self.fresh and self.status.state not in STATES_WITHOUT_DATA

    @property
    def states(self) -> dict[str, float]:
        """States of the model beside the rates, rad and m/s, by name; empty if it has none."""
        entries = self._entries
        return {k.removeprefix(STATE): v for k, v in entries.items() if k.startswith(STATE)}

    def modes(self) -> list[Mode]:
        """Return the modes of the model in level flight; none without flow angles."""
        structure, airspeed = STRUCTURES.get(self.status.values.get("structure", "")), "airspeed"
        if structure is None or airspeed not in self.states:
            return []
        values = np.zeros(structure.mask.shape)
        sigma = np.zeros(structure.mask.shape)
        for coefficient in self.coefficients():
            index = structure.index(coefficient.name)
            values[index], sigma[index] = coefficient.value, coefficient.sigma
        return level_modes(structure, values, sigma, self.states[airspeed])

    def fit_of(self, row: str) -> tuple[float | None, float | None]:
        """Return the running fit of a moment equation and that of holding its rate, percent.

        None before the first, and where the node does not publish it.
        """
        axis, entries = AXIS_OF[row], self._entries
        known = any(entries.get(name) for name in FIT_NAMES)
        hold = self.status.number(f"hold {axis} [%]")
        return (entries.get(f"fit/{axis}") if known else None), hold

    def rows(self) -> list[str]:
        """Rows of the model, in the order of the message; the moment equations before any."""
        return list(dict.fromkeys([*AXIS_OF, *(c.row for c in self.coefficients())]))

    def usable_row(self, row: str) -> bool | None:
        """Return the verdict on a row; None if the node gives none."""
        verdict = self._entries.get(f"{USABLE_NAME}/{row}")
        return None if verdict is None else verdict >= 1.0 and self.fresh

    def coefficients(self) -> list[Coefficient]:
        """Every coefficient, in the order of the message."""
        past = [*(values for _, values in self._past), tuple(self._entries.values())]
        entries = zip(self._entries.items(), self._sigmas, zip(*past, strict=True), strict=True)
        return [
            Coefficient(name, value, sigma, history)
            for (name, value), sigma, history in entries
            if not name.startswith(NOT_COEFFICIENTS)
        ]
