# SPDX-License-Identifier: Apache-2.0
"""Reader of ArduPilot dataflash logs: messages as arrays, parameters, damage.

Every message begins with two fixed bytes and the number of its type. FMT messages declare length
and fields of the types. Behind damaged bytes reading continues at the next certain message, and
the findings give the loss.
"""

import re
import struct
from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uav_ident_ros.identification.samples import NS
from uav_ident_ros.import_logs.binary import CUT_OFF, BinaryLog
from uav_ident_ros.import_logs.log import STAMPS, Column, Log, Messages

SYNC = b"\xa3\x95"
"""First bytes of every message, before the number of its type."""

FMT = 0x80
"""Type of the messages that declare the types."""

MAGIC = SYNC + bytes([FMT])
"""First bytes of every dataflash log."""

SDLOG2 = ("TIME", "StartTime")
"""Type and field of the time in sdlog2, PX4's format before ULog, which has the same framing. No
other message of it has a stamp."""

TRAILER = 528
"""Largest page of a log, bytes: less than a page behind the last message is padding, no damage."""

OLD_INSTANCES = {"IMU2": ("IMU", 1), "IMU3": ("IMU", 2)}
"""Present type and instance of the old types of messages, which had no field `I`, the instance."""

FIELD_TYPES = {
    "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8",
    "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4", "M": "i1",
    "g": "<f2", "f": "<f4", "d": "<f8", "n": "S4", "N": "S16", "Z": "S64", "a": "S64",
}  # fmt: skip
"""NumPy type of each format character."""

DIVISORS = {**dict.fromkeys("cCeE", 100.0), "L": 1e7}
"""Divisors of the integers of a format character."""


@dataclass
class Kind:
    """A declared type of messages."""

    name: str
    dtype: np.dtype[np.void]  # Its first field is the header
    divisors: dict[str, float]  # Divisors of the scaled fields

    def columns(self, data: bytes, places: Sequence[int]) -> dict[str, Column]:
        """Return the fields of the messages at some places as arrays, in declared units."""
        size, divisors = self.dtype.itemsize, self.divisors
        rows = np.frombuffer(b"".join(data[at : at + size] for at in places), self.dtype)
        return {
            name: rows[name] / divisors[name] if name in divisors else rows[name]
            for name in (self.dtype.names or ())[1:]
        }


def read_dataflash(path: Path, types: Collection[str]) -> Log:
    """Read messages of some types, texts and parameters; refuse other formats of this framing."""
    log, data = Log(path), path.read_bytes()
    found = _Dataflash(data)
    places, gaps = found.walk(0)
    name, field = SDLOG2
    if any(k.name == name and field in (k.dtype.names or ()) for k in found.kinds.values()):
        raise log.refusal(
            " is of sdlog2, PX4's format before ULog: write it into a CSV with PX4's "
            f"sdlog2_dump.py, and give --columns (time {name}_{field} in us, rates IMU_Gyro*)"
        )
    by_number = {number: array("q") for number in found.kinds}
    for at in places:
        by_number[data[at + 2]].append(at)
    taken = set[str]()
    for number, kind in found.kinds.items():
        if not by_number[number]:
            continue
        log.kinds.add(kind.name)
        if kind.name in taken or kind.name not in {*types, *OLD_INSTANCES, "MSG", "PARM"}:
            continue
        taken.add(kind.name)
        columns = kind.columns(data, by_number[number])
        if kind.name == "MSG":
            log.texts += map(_text, columns.get("Message", ()))
        elif kind.name == "PARM":
            _take_parameters(log, columns)
        elif STAMPS.keys() & columns:
            name, instance = OLD_INSTANCES.get(kind.name, (kind.name, 0))
            log.add(name, columns, columns.get("I", instance))
    found.note_loss(log, gaps)
    return log


def _take_parameters(log: Log, columns: dict[str, Column]) -> None:
    names, values = (columns.get(field, np.zeros(0)) for field in ("Name", "Value"))
    stamped = STAMPS.keys() & columns
    t = Messages("", columns).stamp_ns * NS if stamped else np.zeros(len(values))
    for name, value, at in zip(names, values.tolist(), t.tolist(), strict=False):
        log.set_parameter(_text(name), float(value), at)


class _Dataflash(BinaryLog):
    begins = re.compile(rb"(?!)")

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.kinds: dict[int, Kind] = {}
        self._declare(FMT, _kind(b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns"))

    def _declare(self, number: int, kind: Kind) -> None:
        """Add a type; the first declaration counts, a later one may be damaged."""
        if number not in self.kinds:
            self.kinds[number] = kind
            known = re.escape(bytes(self.kinds))
            self.begins = re.compile(re.escape(SYNC) + b"[" + known + b"]", re.DOTALL)

    def length(self, at: int) -> int:
        header = self.data[at : at + 3]
        kind = self.kinds.get(header[2]) if header[:2] == SYNC and len(header) == 3 else None
        return kind.dtype.itemsize if kind and at + kind.dtype.itemsize <= self.size else 0

    def is_misread(self, last: int, at: int, following: int) -> bool:
        # Then message plus gap have the length of a type, and at most one header byte is right.
        first, second, number = self.data[at : at + 3].ljust(3, b"\0")
        alike = (first == SYNC[0]) + (second == SYNC[1]) + (number in self.kinds)
        lengths = {kind.dtype.itemsize for kind in self.kinds.values()}
        return following - last in lengths and alike < 2

    def register(self, at: int, length: int) -> None:
        if self.data[at + 2] != FMT:
            return
        declared, size, *texts = struct.unpack("<3xBB4s16s64s", self.data[at : at + length])
        try:
            kind = _kind(*texts)
        except ValueError:  # contradictory
            return
        if kind.dtype.itemsize == size:
            self._declare(declared, kind)

    def rest(self, at: int) -> str | None:
        if self.size - at >= TRAILER:
            return None
        return CUT_OFF if self.data[at:].startswith(SYNC) else ""


def _kind(raw_name: bytes, characters: bytes, columns: bytes) -> Kind:
    """Return the declared type of messages; raises ValueError if the declaration is invalid."""
    names = list(filter(None, _text(columns).split(",")))
    types = _text(characters)
    if len(names) != len(types) or not {*types} <= FIELD_TYPES.keys():
        raise ValueError("no such format")
    fields = list(zip(names, types, strict=True))
    dtype = np.dtype([("", "S3"), *((name, FIELD_TYPES[kind]) for name, kind in fields)])
    divisors = {name: DIVISORS[kind] for name, kind in fields if kind in DIVISORS}
    return Kind(_text(raw_name), dtype, divisors)


def _text(characters: bytes) -> str:
    return bytes(characters).split(b"\0")[0].decode(errors="replace")
