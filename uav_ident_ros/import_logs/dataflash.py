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
from functools import partial
from pathlib import Path

import numpy as np

from uav_ident_ros.import_logs.log import (
    STAMPS,
    BinaryLog,
    Gap,
    Log,
    Messages,
    Places,
    Records,
    read_binary,
)

HEADER = b"\xa3\x95"
"""First bytes of every message, before the number of its type."""

FMT = 0x80
"""Type of the messages that declare the types."""

MAGIC = HEADER + bytes([FMT])
"""First bytes of every dataflash log."""

TRAILER = 528
"""Logs are written in pages of at most so many bytes: less than one behind the last message is
no damage."""

INSTANCE_FIELD = "I"

OLD_INSTANCES = {"IMU2": ("IMU", 1), "IMU3": ("IMU", 2)}
"""Type and instance of what was a type of its own before there was a field for it."""

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


def read_dataflash(path: Path, types: Collection[str]) -> Log:
    """Read some types of the messages of a dataflash log.

    Raises
    ------
    ImportLogError
        If the file cannot be read.
    """
    return read_binary(path, partial(_Dataflash, types=types), 0)


class _Dataflash(BinaryLog):
    begins = re.compile(rb"(?!)")

    def __init__(self, data: mmap.mmap, log: Log, types: Collection[str]) -> None:
        super().__init__(data, log)
        self._types, self._kinds = types, dict[int, Records]()
        self._declare(FMT, _kind(b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns"))

    def _declare(self, number: int, kind: Records) -> None:
        """Take a type; the first declaration counts, a later one may be damaged."""
        if number not in self._kinds:
            self._kinds[number] = kind
            self.lengths.add(kind.dtype.itemsize)
            known = re.escape(bytes(self._kinds))
            self.begins = re.compile(re.escape(HEADER) + b"[" + known + b"]", re.DOTALL)

    def length(self, at: int) -> int:
        header = self.data[at : at + 3]
        kind = self._kinds.get(header[2]) if header[:2] == HEADER and len(header) == 3 else None
        return kind.dtype.itemsize if kind and at + kind.dtype.itemsize <= self.size else 0

    def resembles(self, at: int) -> bool:
        first, second, number = self.data[at : at + 3].ljust(3, b"\0")
        return (first == HEADER[0]) + (second == HEADER[1]) + (number in self._kinds) >= 2

    def take(self, at: int, length: int) -> Places | None:
        number = self.data[at + 2]
        if number == FMT:
            declared, size, *texts = struct.unpack("<3xBB4s16s64s", self.data[at : at + length])
            try:
                kind = _kind(*texts)
            except ValueError:  # it contradicts itself
                pass
            else:
                if kind.dtype.itemsize == size:
                    self._declare(declared, kind)
        return self._kinds[number].places

    def finish(self, gaps: list[Gap]) -> bool:
        log, taken = self.log, set[str]()
        for kind in self._kinds.values():
            if not kind.places:
                continue
            log.kinds.add(kind.name)
            names = kind.dtype.names or ()
            if kind.name == "MSG" and "Message" in names:
                log.texts += map(_text, kind.columns(self.data)["Message"])
            elif kind.name == "PARM" and {"Name", "Value"} <= set(names):
                self._take_parameters(kind)
            elif kind.name not in taken and set(STAMPS) & set(names):
                taken.add(kind.name)
                kind.name, kind.instance = OLD_INSTANCES.get(kind.name, (kind.name, 0))
                if kind.name in self._types:
                    self.keep(kind, INSTANCE_FIELD)
        stamps = np.hstack(self.stamped)[1, 1:]
        log.start_ns = int(stamps.min()) if len(stamps) else None
        if gaps and gaps[-1][1] == self.size and self.size - gaps[-1][0] < TRAILER:
            if self.data[gaps[-1][0] :][:2] == HEADER:
                return True
            gaps.pop()
        return False

    def _take_parameters(self, kind: Records) -> None:
        columns = kind.columns(self.data)
        timed = set(STAMPS) & set(columns)
        t = Messages("", columns).stamp_ns * 1e-9 if timed else np.zeros(len(kind.places))
        for values in zip(columns["Name"], columns["Value"], t.tolist(), strict=True):
            self.log.set_parameter(_text(values[0]), float(values[1]), values[2])


def _kind(name: bytes, characters: bytes, columns: bytes) -> Records:
    """Return a type of messages as its declaration describes it; ValueError if it cannot be."""
    names = list(filter(None, _text(columns).split(",")))
    found = [FIELD_TYPES.get(character, ("", 0.0)) for character in _text(characters)]
    if ("", 0.0) in found or len(names) != len(found):
        raise ValueError("no such format")
    dtype = np.dtype([("", "S3"), *((n, kind) for n, (kind, _) in zip(names, found, strict=True))])
    return Records(_text(name), dtype, [divisor for _, divisor in found])


def _text(characters: bytes) -> str:
    return bytes(characters).split(b"\0")[0].decode(errors="replace")
