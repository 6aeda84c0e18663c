# SPDX-License-Identifier: Apache-2.0
"""An autopilot's log in memory: messages as arrays, parameters, what is damaged.

Binary logs that describe themselves are read here, too: every message, over damaged places.
"""

import mmap
import re
from array import array
from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import BoolArray, FloatArray
from uav_ident_ros.import_logs.flight_log import Findings, ImportLogError
from uav_ident_ros.import_logs.stamps import plausible, rate
from uav_ident_ros.messages.types import NS_PER_US

Column = NDArray[Any]
"""Values of one field, in the type of the log."""

IN_NS = "stamp [ns]"
"""Name of a column of stamps that are in ns already."""

STAMPS = {IN_NS: 1, "timestamp": NS_PER_US, "TimeUS": NS_PER_US, "TimeMS": 1_000_000}
"""Fields of the time since the autopilot's start, and their unit, ns; TimeMS until 2015."""

SAMPLED = ("timestamp_sample", "SampleUS")
"""Fields of the time at which was sampled what a message holds, us."""


@dataclass(frozen=True)
class Messages:
    """All messages of one kind and instance: PX4's topics, ArduPilot's types."""

    name: str  # The kind, with ``[i]`` behind it for an instance beyond the first
    # Array by field name; an entry of an array field is ``field[0]`` and so on
    columns: dict[str, Column]

    def has(self, *fields: str) -> bool:
        """Whether they have all these fields."""
        return set(fields) <= set(self.columns)

    @property
    def stamp_ns(self) -> TimeArray:
        """When they were published or logged, ns since the start of the autopilot."""
        name = next(name for name in STAMPS if name in self.columns)
        return np.asarray(self.columns[name]).astype(np.int64) * STAMPS[name]

    @property
    def sample_ns(self) -> TimeArray:
        """When what they hold was sampled, ns; the same as `stamp_ns` where that is not said."""
        name = next((name for name in SAMPLED if name in self.columns), None)
        if name is None:
            return self.stamp_ns
        sampled = np.asarray(self.columns[name]).astype(np.int64) * NS_PER_US
        return np.where(sampled > 0, sampled, self.stamp_ns)

    @property
    def rate(self) -> float:
        """Messages per second."""
        return rate(self.sample_ns)

    def values(self, *fields: str) -> FloatArray:
        """Values of some fields, shape (k, number of fields)."""
        with np.errstate(invalid="ignore"):  # damaged bytes may be a NaN that signals
            return np.column_stack([self.columns[field] for field in fields]).astype(float)

    def array(self, field: str) -> FloatArray:
        """Values of an array field, shape (k, its length)."""
        count = sum(name.startswith(f"{field}[") for name in self.columns)
        return self.values(*(f"{field}[{i}]" for i in range(count)))


@dataclass
class Log:
    """A log in memory."""

    path: Path  # Where it is from
    title: str = ""  # What wrote it, as far as the log says
    kinds: set[str] = field(default_factory=set)  # Every kind of messages in it
    # Parameters at the start, by name, and time (s), name and value of those that became others
    parameters: dict[str, float] = field(default_factory=dict)
    changes: list[tuple[float, str, float]] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)  # What the autopilot said of itself
    findings: Findings = field(default_factory=Findings)  # What there is to say about it
    start_ns: int | None = None  # Stamp of the start, ns; None if it is not known
    _found: dict[tuple[str, int], Messages] = field(default_factory=dict)

    def refusal(self, reason: str) -> ImportLogError:
        """Return the error that says why the log cannot be imported."""
        return ImportLogError(f"log '{self.path}'{reason}")

    @property
    def end_ns(self) -> int:
        """Newest stamp, ns."""
        return max((int(m.stamp_ns.max()) for m in self._found.values()), default=0)

    def add(
        self, name: str, instance: int, columns: dict[str, Column], instance_field: str = ""
    ) -> tuple[BoolArray, TimeArray]:
        """Add messages; return which are kept, those with a stamp that a clock gave, and theirs.

        With an `instance_field` they are of several instances, as it says.
        """
        t_ns = Messages(name, columns).stamp_ns
        good = plausible(t_ns)
        if not good.all():
            self.findings.damage.append(
                f"{int((~good).sum())} of {len(good)} samples of {name} have a stamp that no clock "
                "gave, and were left out"
            )
        columns = {field: values[good] for field, values in columns.items()}
        which = columns.get(instance_field, np.full(int(good.sum()), instance))
        for number in map(int, np.unique(which)):
            chosen = {field: values[which == number] for field, values in columns.items()}
            named = f"{name}[{number}]" if number else name
            self._found[name, number] = Messages(named, chosen)
            self.kinds.add(name)
        return good, t_ns[good]

    def messages(self, name: str, instance: int = 0) -> Messages | None:
        """Return the messages of a kind and instance, if there are any."""
        return self._found.get((name, instance))

    def instances(self, name: str) -> list[int]:
        """Instances of a kind that have messages."""
        return sorted(number for kind, number in self._found if kind == name)

    def parameter(self, name: str, default: float = 0.0) -> float:
        """Return a parameter, the default if the log does not say it."""
        return float(self.parameters.get(name, default))

    def set_parameter(self, name: str, value: float, t: float) -> None:
        """Take a parameter; a value that is not the first is a change at the time `t`, s."""
        if np.isfinite(value) and self.parameters.setdefault(name, value) != value:
            self.changes.append((t, name, value))


# --- binary logs that describe themselves ---------------------------------------------------------


Gap = tuple[int, int]
"""Where bytes that are no message begin and end."""

Places = MutableSequence[int]
"""Where messages begin."""


@dataclass
class Records:
    """Messages of one kind: how they look, and where they are."""

    name: str
    dtype: np.dtype[np.void]  # Its first field is the header
    divisors: Sequence[float] = ()  # What the values are to be divided by; none if left out
    instance: int = 0
    sizes: range = range(0)  # Bytes that a message may have
    places: Places = field(default_factory=lambda: array("q"))

    def columns(self, data: mmap.mmap) -> dict[str, Column]:
        """Return the fields as arrays, in the units of their declaration."""
        size, names = self.dtype.itemsize, (self.dtype.names or ())[1:]
        rows = np.frombuffer(b"".join(data[at : at + size] for at in self.places), self.dtype)
        divisors = self.divisors or [1.0] * len(names)
        return {
            name: rows[name] if divisor == 1.0 else rows[name] / divisor
            for name, divisor in zip(names, divisors, strict=True)
        }


class BinaryLog:
    """What a format has to say of itself, for its messages to be found over damaged places."""

    begins: re.Pattern[bytes]  # Matches where a message may begin that is certain to be one

    def __init__(self, data: mmap.mmap, log: Log) -> None:
        self.data, self.size, self.log = data, len(data), log
        self.lengths: set[int] = set()  # Lengths that messages with samples can have, bytes
        self.stamped = [np.array([[-1], [0]])]  # Places and stamps, ns, of what was kept

    def length(self, at: int) -> int:
        """Return the length of the message that begins here, bytes; 0 if none does."""
        raise NotImplementedError

    def resembles(self, at: int) -> bool:
        """Return whether what stands here is the begin of a message but for a byte or so."""
        raise NotImplementedError

    def take(self, at: int, length: int) -> Places | None:
        """Take the message that begins here; return the places of its kind, if they are kept."""
        raise NotImplementedError

    def finish(self, gaps: list[Gap]) -> bool:
        """Take the samples; return whether the last of the gaps is a cut at the end."""
        raise NotImplementedError

    def keep(self, records: Records, instance_field: str = "") -> None:
        """Add the samples of some records to the log."""
        columns = records.columns(self.data)
        good, t_ns = self.log.add(records.name, records.instance, columns, instance_field)
        self.stamped.append(np.array([np.array(records.places)[good], t_ns]))

    def walk(self, start: int) -> list[Gap]:
        """Take every message, and return the gaps between them.

        A message is taken if it begins where the one before it ends, or, behind a gap, where one
        begins for certain.
        """
        gaps: list[Gap] = []
        places: Places | None = None
        at = last = start
        while at < self.size:
            if length := self.length(at):
                places = self.take(at, length)
                if places is not None:
                    places.append(at)
                at, last = at + length, at
                continue
            taken = last < at
            following = self._next_certain(last + 1 if taken else at + 1)
            # What has led to no message was none itself, if it reaches into the one that follows,
            # or if with it the gap is as long as a message, and no damaged one begins behind it:
            # then its type is what is damaged.
            misread = following - last in self.lengths and not self.resembles(at)
            if taken and (following < at or misread):
                if places:
                    places.pop()
                at = last
            gaps.append((at, following))
            at = last = following
        return gaps

    def _next_certain(self, start: int) -> int:
        """Return where the next two messages follow each other, or one ends the file."""
        for found in self.begins.finditer(self.data, start):
            end = found.start() + (length := self.length(found.start()))
            if length and (end == self.size or self.length(end)):
                return found.start()
        return self.size

    def note_loss(self, gaps: list[Gap]) -> None:
        """Say how much of the file could not be read."""
        if self.finish(gaps):
            gaps.pop()
            self.log.findings.doubt("the file is cut off at its end: what is there was read")
        if not gaps:
            return
        lost = sum(end - begin for begin, end in gaps)
        kept = np.hstack(self.stamped)
        places, stamps = kept[:, np.argsort(kept[0])]
        lost_ns = 0
        for begin, end in gaps:
            before, after = np.searchsorted(places, begin) - 1, np.searchsorted(places, end)
            if before > 0 and after < len(places):
                lost_ns += max(int(stamps[after] - stamps[before]), 0)
        self.log.findings.damage.insert(
            0,
            f"the file is damaged: {lost} of {self.size} bytes ({100.0 * lost / self.size:.2g} %) "
            f"in {len(gaps)} place{'s' if len(gaps) > 1 else ''}, about {lost_ns * 1e-9:.2g} s of "
            "the log, could not be read; all the rest was",
        )


def read_binary(path: Path, make: Callable[[mmap.mmap, Log], BinaryLog], start: int) -> Log:
    """Read a binary log whose first message begins at `start`.

    Raises
    ------
    ImportLogError
        If the file cannot be read.
    """
    log = Log(path)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            found = make(data, log)
            found.note_loss(found.walk(start))
    except OSError as error:
        raise ImportLogError(f"log '{path}' cannot be read: {error.strerror or error}") from None
    return log
