# SPDX-License-Identifier: Apache-2.0
"""Content of ``/diagnostics``."""

import math
import time
from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.structure import ROWS

TICKS_KEPT = 1200
"""Tick times kept for the percentiles: a minute at 20 Hz."""

LEVELS: dict[str, bytes] = {
    "learning": DiagnosticStatus.OK,
    "converged": DiagnosticStatus.OK,
    "waiting": DiagnosticStatus.WARN,
    "paused": DiagnosticStatus.WARN,
    "fault": DiagnosticStatus.ERROR,
}
"""The diagnostic level of each state."""


class TickMeter:
    """Statistics of the last ticks: duration, age when published, intervals of the timer."""

    def __init__(self, period: float) -> None:
        self.count = 0
        self._period = period  # nominal interval of the timer, s
        self._ages, self._durations, self._intervals = (
            deque[float](maxlen=TICKS_KEPT) for _ in range(3)
        )
        self._last_call = math.inf

    def called(self) -> None:
        """Record a call of the timer."""
        now = time.perf_counter()
        if self._last_call < now:
            self._intervals.append(now - self._last_call)
        self._last_call = now

    def ticked(self, seconds: float) -> None:
        """Record the computing time of a tick, s."""
        self.count += 1
        self._durations.append(seconds)

    def published(self, age: float) -> None:
        """Record the age of a tick when published, s, by the node's clock."""
        self._ages.append(age)

    def values(self) -> Iterator[tuple[str, str]]:
        """Yield the statistics, each with its label."""
        yield "count", str(self.count)
        jitter = [abs(interval - self._period) for interval in self._intervals]
        for name, times, shares, digits in (
            ("age when published", self._ages, (50, 99), 1),
            ("update time", self._durations, (50, 99, 100), 3),
            ("timer interval", self._intervals, (50, 99), 2),
            ("timer jitter", jitter, (99,), 2),
        ):
            if times:
                for share, seconds in zip(shares, np.percentile(times, shares), strict=True):
                    which = f"p{share}" if share < 100 else "max"
                    yield f"{name} {which} [ms]", f"{1e3 * seconds:.{digits}f}"


def grouped(group: str, values: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Yield labelled values with the name of their group before each label."""
    return ((f"{group}: {label}", value) for label, value in values)


def estimate_values(estimate: Estimate, identifier: OnlineIdentifier) -> Iterator[tuple[str, str]]:
    """Yield the values of the last estimate and of the flight so far, each with its label."""
    information, supervisor = identifier.estimator.information, identifier.supervisor
    yield "adapting", str(estimate.adapting).lower()
    yield "usable", str(estimate.usable).lower()
    yield "tick [s]", f"{estimate.t_ns * NS:.3f}"
    for row, excitation in zip(ROWS, information.excitation(), strict=True):
        yield f"excitation {row} [0..1]", f"{excitation:.3f}"
    running = identifier.running_fit
    for label, fits in (
        ("fit", estimate.fit),
        ("hold", running.hold),
        ("saved fit", running.saved),
    ):
        for axis, fit in zip("pqr", fits, strict=True):
            yield f"{label} {axis} [%]", f"{fit:.1f}"
    yield "delay [s]", f"{identifier.delay:.4f}"
    yield "delay confidence", identifier.delay_estimate.confidence
    if (found := identifier.delays.estimate).lag_sure:
        in_use = f"{identifier.lag:.3f} in use"
        yield "servo lag [s]", f"{found.lag:.3f} +- {found.lag_sigma:.3f}, {in_use}"
    gates = (
        f"{name} {100.0 * cost.share:.0f} ({cost.setting})"
        for name, cost in supervisor.gates.costs().items()
    )
    for label, separator, found_so_far in (
        ("collinear", "; ", map(", ".join, information.collinear())),
        ("gates [% of the flight]", ", ", gates),
        ("implausible", "; ", (f.text for f in identifier.plausibility.findings)),
        ("changed in flight", ", ", (c.name for c in supervisor.changed if not c.prior_rejected)),
        ("told wrong", ", ", (c.name for c in supervisor.changed if c.prior_rejected)),
    ):
        yield label, separator.join(found_so_far) or "nothing"
