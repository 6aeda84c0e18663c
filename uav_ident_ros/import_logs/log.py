# SPDX-License-Identifier: Apache-2.0
"""A log in memory: messages as arrays, parameters, findings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import BoolArray, FloatArray
from uav_ident_ros.import_logs.stamps import hold, plausible, rate
from uav_ident_ros.messages.types import NS_PER_US

Column = NDArray[Any]
"""Values of one field, in the type of the log."""

IN_NS = "stamp [ns]"
"""Name of a column of stamps in ns."""

_MS = 1_000_000
STAMPS = {IN_NS: 1, "timestamp": NS_PER_US, "TimeUS": NS_PER_US, "T": _MS, "TimeMS": _MS}
"""Fields of the time since the autopilot's start, and their unit in ns; TimeMS until 2015. That of
GPS was the time of the week, beside T since the start."""

SAMPLED = ("timestamp_sample", "SampleUS")
"""Fields of the sample time of a message's values, us."""

JOIN_NS = 200_000
"""Longest time between samples of two topics from one cycle of the controller, ns. Cycles take
about 1 ms or more; the messages of one cycle are some microseconds apart."""


class ImportLogError(Exception):
    """A log cannot be imported; the message names the file and the reason."""


@dataclass(frozen=True, eq=False)
class LogStream:
    """Samples of one kind."""

    source: str  # Messages or topic in the log
    t_ns: TimeArray  # (n,) Stamps, ns, in the order of the log
    values: NDArray[Any]  # (n, ...) Values; see `FlightLog.streams`

    def chosen(self, keep: BoolArray) -> LogStream:
        """Return the stream of the samples with `keep` true."""
        return LogStream(self.source, self.t_ns[keep], self.values[keep])

    def joined(self, other: LogStream) -> LogStream:
        """Return both side by side, (n, C1 + C2); each value holds until its stream's next.

        Stamps closer than `JOIN_NS`, of one controller cycle, merge into the later one. Before
        the first sample of a stream its values are NaN.
        """
        every = np.union1d(self.t_ns, other.t_ns)
        t_ns = every[np.append(np.diff(every) > JOIN_NS, True)]
        values = np.hstack([hold(t_ns, part.t_ns, part.values) for part in (self, other)])
        return LogStream(f"{self.source} and {other.source}", t_ns, values)


@dataclass(frozen=True)
class Messages:
    """All messages of one kind and instance: PX4's topics, ArduPilot's types."""

    name: str  # The kind, followed by ``[i]`` for an instance beyond the first
    # Array by field name; an entry of an array field is ``field[0]`` and so on
    columns: dict[str, Column]

    def has(self, *fields: str) -> bool:
        """Return whether the messages have all these fields."""
        return set(fields) <= set(self.columns)

    @property
    def stamp_ns(self) -> TimeArray:
        """Times of publication or logging, ns since the start of the autopilot."""
        name = next(name for name in STAMPS if name in self.columns)
        return np.asarray(self.columns[name]).astype(np.int64) * STAMPS[name]

    @property
    def sample_ns(self) -> TimeArray:
        """Sample times of the values, ns; `stamp_ns` where not logged."""
        name = next((name for name in SAMPLED if name in self.columns), None)
        if name is None:
            return self.stamp_ns
        sampled = np.asarray(self.columns[name]).astype(np.int64) * NS_PER_US
        return np.where(sampled > 0, sampled, self.stamp_ns)

    @property
    def rate(self) -> float:
        """Sample rate, Hz."""
        return rate(self.sample_ns)

    def values(self, *fields: str) -> FloatArray:
        """Return the values of some fields, shape (k, number of fields)."""
        with np.errstate(invalid="ignore"):  # damaged bytes may be a signalling NaN
            return np.column_stack([self.columns[field] for field in fields]).astype(float)

    def stream(self, *fields: str) -> LogStream:
        """Return the stream of some fields, at the times of publication."""
        return LogStream(self.name, self.stamp_ns, self.values(*fields))

    def array(self, field: str) -> FloatArray:
        """Return the values of an array field, shape (k, its length)."""
        count = sum(name.startswith(f"{field}[") for name in self.columns)
        return self.values(*(f"{field}[{i}]" for i in range(count)))


@dataclass
class Findings:
    """Facts, assumptions and defects of an import, a sentence each."""

    damage: list[str] = field(default_factory=list)  # Unreadable parts of the file
    read: list[str] = field(default_factory=list)  # Facts from the log
    # Assumptions where the log has no information
    assumed: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)  # Missing or doubtful data


@dataclass
class Log:
    """A log in memory."""

    path: Path  # The log's file or folder
    title: str = ""  # Firmware and version; empty if not logged
    kinds: set[str] = field(default_factory=set)  # Every kind of messages in it
    # Parameters at the start, by name; time (s), name and value of each later change
    parameters: dict[str, float] = field(default_factory=dict)
    changes: list[tuple[float, str, float]] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)  # Text messages of the autopilot
    findings: Findings = field(default_factory=Findings)  # Facts, assumptions and defects
    _found: dict[tuple[str, int], Messages] = field(default_factory=dict)

    def refusal(self, reason: str) -> ImportLogError:
        """Return the error of a log that cannot be imported, with the reason."""
        return ImportLogError(f"log '{self.path}'{reason}")

    def lacks(self, library: str, kind: str, extra: str, pinned: str) -> ImportLogError:
        """Return the error of a library that is not installed."""
        return self.refusal(
            f": {library} is not installed, which reads {kind}: "
            f"pip install 'uav_ident_ros[{extra}]' or pip install '{pinned}'"
        )

    @property
    def start_ns(self) -> int:
        """Oldest stamp, ns."""
        return min((int(m.stamp_ns.min()) for m in self._found.values()), default=0)

    @property
    def end_ns(self) -> int:
        """Newest stamp, ns."""
        return max((int(m.stamp_ns.max()) for m in self._found.values()), default=0)

    def add(self, name: str, columns: dict[str, Column], instance: int | Column = 0) -> None:
        """Add the messages with plausible stamps, of one instance or each of its own."""
        good = plausible(Messages(name, columns).stamp_ns)
        if not good.all():
            self.findings.damage.append(
                f"{int((~good).sum())} of {len(good)} samples of {name} have an implausible "
                "stamp and were left out"
            )
        which = np.broadcast_to(instance, good.shape)
        for number in map(int, np.unique(which[good])):
            chosen = {f: values[good & (which == number)] for f, values in columns.items()}
            named = f"{name}[{number}]" if number else name
            self._found[name, number] = Messages(named, chosen)
            self.kinds.add(name)

    def messages(self, name: str, instance: int = 0) -> Messages | None:
        """Return the messages of a kind and instance; None if there are none."""
        return self._found.get((name, instance))

    def instances(self, name: str) -> list[int]:
        """Return the instances of a kind that have messages."""
        return sorted(number for kind, number in self._found if kind == name)

    def parameter(self, name: str, default: float = 0.0) -> float:
        """Return the value of a parameter; the default if it is not logged."""
        return float(self.parameters.get(name, default))

    def set_parameter(self, name: str, value: float, t: float) -> None:
        """Store the first finite value of a parameter; another one is a change at time `t`, s."""
        if np.isfinite(value) and self.parameters.setdefault(name, value) != value:
            self.changes.append((t, name, value))
