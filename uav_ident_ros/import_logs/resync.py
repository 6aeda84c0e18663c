# SPDX-License-Identifier: Apache-2.0
"""Binary logs that describe themselves: every message, over damaged places, as arrays."""

import mmap
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from uav_ident_ros.import_logs.flight_log import ImportLogError
from uav_ident_ros.import_logs.log import Column, Log

Gap = tuple[int, int]
"""Where bytes that are no message begin and end."""


@dataclass
class Records:
    """Messages of one kind: how they look, and where they are."""

    name: str
    dtype: np.dtype[np.void]  # Its first field is the header
    divisors: Sequence[float] = ()  # What the values are to be divided by; none if left out
    instance: int = 0
    sizes: range = range(0)  # Bytes that a message may have
    places: list[int] = field(default_factory=list)  # Where they begin

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
        self.stamped: list[tuple[int, int]] = []  # Place and stamp, ns, of what was kept

    def length(self, at: int) -> int:
        """Return the length of the message that begins here, bytes; 0 if none does."""
        raise NotImplementedError

    def resembles(self, at: int) -> bool:
        """Return whether what stands here is the begin of a message but for a byte or so."""
        raise NotImplementedError

    def take(self, at: int, length: int) -> list[int] | None:
        """Take the message that begins here; return the places of its kind, if they are kept."""
        raise NotImplementedError

    def finish(self, gaps: list[Gap]) -> bool:
        """Take the samples; return whether the last of the gaps is a cut at the end."""
        raise NotImplementedError

    def keep(self, records: Records, instance_field: str = "") -> None:
        """Add the samples of some records to the log."""
        columns = records.columns(self.data)
        good, t_ns = self.log.add(records.name, records.instance, columns, instance_field)
        self.stamped += zip(np.array(records.places)[good].tolist(), t_ns.tolist(), strict=True)

    def walk(self, start: int) -> list[Gap]:
        """Take every message, and return the gaps between them.

        A message is taken if it begins where the one before it ends, or, behind a gap, where one
        begins for certain.
        """
        gaps: list[Gap] = []
        places: list[int] | None = None
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
        places, stamps = np.array([(-1, 0), *sorted(self.stamped)]).T
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
