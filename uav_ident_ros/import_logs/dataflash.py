# SPDX-License-Identifier: Apache-2.0
"""An ArduPilot dataflash log file: messages as arrays, parameters, what is damaged.

The format describes itself: every message begins with two fixed bytes and the number of its type,
and FMT messages say how long a type is and what it holds. Where that does not hold, the reader
looks for the next place where it does, and says how much lies between.
"""

from __future__ import annotations

import mmap
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import NS_PER_US, Column, ImportLogError
from uav_ident_ros.import_logs.resync import Gap, loss_in_words, walk
from uav_ident_ros.import_logs.stamps import LATEST_NS, plausible, rate

HEADER = b"\xa3\x95"
"""First bytes of every message."""

HEADER_SIZE = 3
"""The header and the number of the type, bytes."""

FMT = 0x80
"""Type of the messages that declare the types."""

MAGIC = HEADER + bytes([FMT])
"""First bytes of every dataflash log."""

TRAILER = 528
"""Logs are written in pages of at most so many bytes: less than one behind the last message is
no damage."""

STAMPS = {"TimeUS": NS_PER_US, "TimeMS": 1_000_000}
"""Fields of the time since the autopilot's start, and their unit, ns; TimeMS until 2015."""

INSTANCE_FIELD = "I"

FIELD_TYPES: dict[str, tuple[str, float]] = {
    **dict.fromkeys("bM", ("i1", 1.0)),
    **{"B": ("u1", 1.0), "h": ("<i2", 1.0), "H": ("<u2", 1.0), "i": ("<i4", 1.0)},
    **{"I": ("<u4", 1.0), "q": ("<i8", 1.0), "Q": ("<u8", 1.0)},
    **{"g": ("<f2", 1.0), "f": ("<f4", 1.0), "d": ("<f8", 1.0)},
    **{"c": ("<i2", 100.0), "C": ("<u2", 100.0), "e": ("<i4", 100.0), "E": ("<u4", 100.0)},
    **{"L": ("<i4", 1e7), "n": ("S4", 1.0), "N": ("S16", 1.0), "Z": ("S64", 1.0)},
    "a": ("S64", 1.0),
}
"""NumPy type of each format character, and what its integers are to be divided by."""


class Messages:
    """All messages of one type and instance.

    Parameters
    ----------
    name : str
        Type, with ``[i]`` behind it for an instance beyond the first.
    columns : dict
        Array of values by field name.
    """

    def __init__(self, name: str, columns: dict[str, Column]) -> None:
        self.name = name
        self.columns = columns

    def __contains__(self, field: str) -> bool:
        """Whether they have such a field."""
        return field in self.columns

    @property
    def stamp_ns(self) -> TimeArray:
        """When they were logged, ns since the start of the autopilot."""
        name = next(name for name in STAMPS if name in self)
        return self._ns(name, STAMPS[name])

    @property
    def sample_ns(self) -> TimeArray:
        """When what they hold was sampled, ns; when it was logged if that is not said."""
        return self._ns("SampleUS", NS_PER_US) if "SampleUS" in self else self.stamp_ns

    def _ns(self, name: str, unit: int) -> TimeArray:
        return np.asarray(self.columns[name]).astype(np.int64) * unit

    @property
    def rate(self) -> float:
        """Messages per second."""
        return rate(self.sample_ns)

    def values(self, *fields: str) -> FloatArray:
        """Values of some fields, shape (k, number of fields)."""
        with np.errstate(invalid="ignore"):  # damaged bytes may be a NaN that signals
            return np.column_stack([self.columns[field] for field in fields]).astype(float)


@dataclass(frozen=True)
class _Format:
    """One type of messages: its name, length in bytes, fields."""

    name: str
    size: int
    dtype: np.dtype[np.void]
    divisors: tuple[float, ...]


class _Walker:
    """Finds the messages of a file.

    Attributes
    ----------
    formats : dict
        Types, by their number.
    places : dict
        Where the messages of each type begin.
    lengths : set of int
        Lengths of the types, bytes.
    """

    def __init__(self, data: mmap.mmap) -> None:
        self._data, self._size = data, len(data)
        self.formats: dict[int, _Format] = {}
        self.places: dict[int, list[int]] = {}
        self.lengths: set[int] = set()
        self._sizes = [0] * 256
        self._last = FMT
        self._begin = re.compile(rb"(?!)")
        self._declare(FMT, _format(b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns"))

    def length(self, at: int) -> int:
        data = self._data
        if at + HEADER_SIZE > self._size or data[at : at + 2] != HEADER:
            return 0
        size = self._sizes[data[at + 2]]
        return size if at + size <= self._size else 0

    def next_certain(self, start: int) -> int:
        for found in self._begin.finditer(self._data, start):
            at = found.start()
            end = at + self._sizes[self._data[at + 2]]
            if end == self._size or self._begin.match(self._data, end):
                return at
        return self._size

    def resembles(self, at: int) -> bool:
        first, second, number = self._data[at : at + HEADER_SIZE].ljust(HEADER_SIZE, b"\0")
        return (first == HEADER[0]) + (second == HEADER[1]) + (self._sizes[number] > 0) >= 2

    def take(self, at: int) -> None:
        self._last = number = self._data[at + 2]
        self.places[number].append(at)
        if number == FMT:
            self._take_format(self._data[at : at + self._sizes[FMT]])

    def take_back(self) -> None:
        self.places[self._last].pop()

    def _take_format(self, message: bytes) -> None:
        """Take the declaration of a type, unless it contradicts itself."""
        number, length, *texts = struct.unpack("<BB4s16s64s", message[HEADER_SIZE:])
        try:
            declared = _format(*texts)
        except ValueError:
            return
        if declared.size == length:
            self._declare(number, declared)

    def _declare(self, number: int, declared: _Format) -> None:
        """Take a type; the first declaration counts, a later one may be damaged."""
        if number not in self.formats:
            self.formats[number], self.places[number] = declared, []
            self._sizes[number] = declared.size
            self.lengths.add(declared.size)
            known = re.escape(bytes(self.formats))
            self._begin = re.compile(re.escape(HEADER) + b"[" + known + b"]", re.DOTALL)


class DataflashLog:
    """An ArduPilot log in memory: some types of its messages.

    Parameters
    ----------
    path : Path
        Dataflash file.
    types : tuple of str
        The types to read.

    Attributes
    ----------
    parameters : dict
        Parameters as first logged, by name.
    changes : list of tuple
        Time (s), name and value of every parameter that changed afterwards.
    texts : list of str
        The MSG messages.
    damage : list of str
        What could not be read, and how much it is.
    remarks : list of str
        What else there is to say about the file.
    start_ns, end_ns : int
        Oldest and newest stamp, ns.

    Raises
    ------
    ImportLogError
        If the file cannot be read.
    """

    def __init__(self, path: Path, types: tuple[str, ...]) -> None:
        self.path = path
        self.parameters: dict[str, float] = {}
        self.changes: list[tuple[float, str, float]] = []
        self.texts: list[str] = []
        self.damage: list[str] = []
        self.remarks: list[str] = []
        self.start_ns, self.end_ns = LATEST_NS, 0
        self._columns: dict[str, dict[str, Column]] = {}
        try:
            with (
                path.open("rb") as file,
                mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
            ):
                contents = _Walker(data)
                gaps = walk(contents, 0, len(data))
                self._types = sorted(
                    f.name for n, f in contents.formats.items() if contents.places[n]
                )
                stamped = self._read(data, contents, types)
                self._say_gaps(data, gaps, stamped)
        except OSError as error:
            raise ImportLogError(
                f"log '{path}' cannot be read: {error.strerror or error}"
            ) from None

    def messages(self, name: str, instance: int = 0) -> Messages | None:
        """Return the messages of a type and instance, if there are any with a stamp."""
        columns = self._columns.get(name)
        if columns is None or instance not in self.instances(name):
            return None
        if INSTANCE_FIELD in columns:
            chosen = columns[INSTANCE_FIELD] == instance
            columns = {field: values[chosen] for field, values in columns.items()}
        return Messages(f"{name}[{instance}]" if instance else name, columns)

    def instances(self, name: str) -> list[int]:
        """Instances of a type that have messages."""
        columns = self._columns.get(name, {})
        if INSTANCE_FIELD in columns:
            return [int(number) for number in np.unique(columns[INSTANCE_FIELD])]
        return [0] if any(map(len, columns.values())) else []

    def contents(self) -> str:
        """List the message types in one line."""
        return ", ".join(self._types) or "no messages at all"

    def _read(
        self, data: mmap.mmap, contents: _Walker, types: tuple[str, ...]
    ) -> list[tuple[int, int]]:
        """Keep the messages wanted; return place and stamp (ns) of all that have one, in order."""
        stamped: list[tuple[int, int]] = []
        for number, declared in contents.formats.items():
            places = contents.places[number]
            if not places or declared.name not in {*types, "PARM", "MSG"}:
                continue
            columns = _columns(data, declared, places)
            if declared.name == "MSG" and "Message" in columns:
                self.texts += [_text(message) for message in columns["Message"]]
            elif declared.name == "PARM" and {"Name", "Value"} <= set(columns):
                self._take_parameters(columns)
            elif declared.name not in self._columns and any(name in columns for name in STAMPS):
                t_ns = Messages(declared.name, columns).stamp_ns
                good = plausible(t_ns)
                self._columns[declared.name] = {n: values[good] for n, values in columns.items()}
                if good.any():
                    self.start_ns = min(self.start_ns, int(t_ns[good].min()))
                    self.end_ns = max(self.end_ns, int(t_ns[good].max()))
                if not good.all():
                    self.damage.append(
                        f"{int((~good).sum())} of {len(good)} messages {declared.name} have a "
                        "stamp that no clock gave, and were left out"
                    )
                kept = np.flatnonzero(good)
                stamped += zip(np.array(places)[kept].tolist(), t_ns[kept].tolist(), strict=True)
        return sorted(stamped)

    def _take_parameters(self, columns: dict[str, Column]) -> None:
        stamps = [(columns[name], unit) for name, unit in STAMPS.items() if name in columns]
        for i, (name, value) in enumerate(zip(columns["Name"], columns["Value"], strict=True)):
            if not np.isfinite(value):
                continue
            before = self.parameters.setdefault(_text(name), float(value))
            if before != value:
                t = float(stamps[0][0][i]) * stamps[0][1] * 1e-9 if stamps else 0.0
                self.changes.append((t, _text(name), float(value)))

    def _say_gaps(self, data: mmap.mmap, gaps: list[Gap], stamped: list[tuple[int, int]]) -> None:
        """Say how much could not be read."""
        if gaps and gaps[-1][1] == len(data) and len(data) - gaps[-1][0] < TRAILER:
            begin, _ = gaps.pop()
            if data[begin : begin + 2] == HEADER:
                self.remarks.append("the file is cut off at its end: what is there was read")
        if gaps:
            self.damage.insert(0, loss_in_words(gaps, len(data), stamped))


def _format(name: bytes, characters: bytes, columns: bytes) -> _Format:
    """Return a type of messages as its declaration describes it.

    Raises
    ------
    ValueError
        If there is no such field type, or there are not as many names as types, or one twice.
    """
    kinds = _text(characters)
    names = _text(columns).split(",") if _text(columns) else []
    if any(kind not in FIELD_TYPES for kind in kinds) or len(names) != len(kinds):
        raise ValueError("no such format")
    fields = [(n, FIELD_TYPES[kind][0]) for n, kind in zip(names, kinds, strict=True)]
    dtype = np.dtype([("", "S3"), *fields])
    divisors = tuple(FIELD_TYPES[kind][1] for kind in kinds)
    return _Format(_text(name), dtype.itemsize, dtype, divisors)


def _columns(data: mmap.mmap, declared: _Format, places: list[int]) -> dict[str, Column]:
    """Return the fields of messages as arrays, in the units of their declaration."""
    size = declared.size
    table = np.frombuffer(b"".join(data[at : at + size] for at in places), dtype=declared.dtype)
    names = (declared.dtype.names or ())[1:]
    return {
        name: table[name] if divisor == 1.0 else table[name] / divisor
        for name, divisor in zip(names, declared.divisors, strict=True)
    }


def _text(characters: bytes) -> str:
    return bytes(characters).split(b"\0")[0].decode(errors="replace")
