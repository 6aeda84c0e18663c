# SPDX-License-Identifier: Apache-2.0
"""An ArduPilot dataflash log file: messages as arrays, parameters, what is damaged.

The format describes itself: every message begins with two fixed bytes and the number of its type,
and FMT messages say how long a type is and what it holds. Where that does not hold, the reader
looks for the next place where it does, and says how much lies between.
"""

import mmap
import re
import struct
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uav_ident_ros.import_logs.flight_log import ImportLogError
from uav_ident_ros.import_logs.log import STAMPS, Column, Log, Messages
from uav_ident_ros.import_logs.resync import walk

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


@dataclass(frozen=True)
class _Format:
    """One type of messages: its name, length in bytes, fields."""

    name: str
    size: int
    dtype: np.dtype[np.void]
    divisors: tuple[float, ...]


class _Walker:
    def __init__(self, data: mmap.mmap) -> None:
        self._data, self._size = data, len(data)
        self.formats: dict[int, _Format] = {}  # Types, by their number
        self.places: dict[int, list[int]] = {}  # Where the messages of each type begin
        self.lengths: set[int] = set()  # Lengths of the types, bytes
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


def read_dataflash(path: Path, types: Collection[str]) -> Log:
    """Read some types of the messages of a dataflash log.

    Raises
    ------
    ImportLogError
        If the file cannot be read.
    """
    log = Log(path)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            found = _Walker(data)
            gaps = walk(found, 0, len(data))
            stamped = _take(log, data, found, {*types, "PARM", "MSG"})
            log.start_ns = min((t_ns for _, t_ns in stamped), default=None)
            if gaps and gaps[-1][1] == len(data) and len(data) - gaps[-1][0] < TRAILER:
                begin = gaps[-1][0]
                cut = data[begin : begin + 2] == HEADER
                gaps = gaps if cut else gaps[:-1]
                log.say_loss(gaps, len(data), stamped, cut=cut)
            else:
                log.say_loss(gaps, len(data), stamped, cut=False)
    except OSError as error:
        raise ImportLogError(f"log '{path}' cannot be read: {error.strerror or error}") from None
    return log


def _take(
    log: Log, data: mmap.mmap, found: _Walker, types: Collection[str]
) -> list[tuple[int, int]]:
    """Take the messages wanted; return place and stamp (ns) of all that have one."""
    stamped: list[tuple[int, int]] = []
    taken: set[str] = set()
    for number, declared in found.formats.items():
        name, places = declared.name, found.places[number]
        if places:
            log.kinds.add(name)
        if not places or name not in types:
            continue
        columns = _columns(data, declared, places)
        if name == "MSG" and "Message" in columns:
            log.texts += [_text(message) for message in columns["Message"]]
        elif name == "PARM" and {"Name", "Value"} <= set(columns):
            stamps = Messages(name, columns)
            timed = any(n in stamps for n in STAMPS)
            t = stamps.stamp_ns * 1e-9 if timed else np.zeros(len(places))
            for values in zip(columns["Name"], columns["Value"], t.tolist(), strict=True):
                log.set_parameter(_text(values[0]), float(values[1]), values[2])
        elif name not in taken and any(n in columns for n in STAMPS):
            taken.add(name)
            good = log.add(name, 0, columns, INSTANCE_FIELD)
            t_ns = Messages(name, columns).stamp_ns[good]
            stamped += zip(np.array(places)[good].tolist(), t_ns.tolist(), strict=True)
    return stamped


def _format(name: bytes, characters: bytes, columns: bytes) -> _Format:
    """Return a type of messages as its declaration describes it."""
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
