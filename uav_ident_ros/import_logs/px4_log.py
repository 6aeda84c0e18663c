# SPDX-License-Identifier: Apache-2.0
"""A PX4 log file (ULog): topics as arrays, parameters, what is damaged.

The format describes itself, by https://docs.px4.io/main/en/dev_log/ulog_file_format: behind a
header of 16 bytes every message begins with its size and a letter for its type. F declares a
format, A a topic of it, P a parameter, I a fact; D is a sample of a topic.
"""

import mmap
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.import_logs.flight_log import ImportLogError
from uav_ident_ros.import_logs.log import Column, Log
from uav_ident_ros.import_logs.resync import walk
from uav_ident_ros.messages.types import NS_PER_US

MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
"""First bytes of every ULog file."""

FILE_HEADER, MESSAGE_HEADER, DATA_HEADER = 16, 3, 5
"""Bytes before the first message, before what a message holds, before the values of a sample."""

SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
"""Content of the messages that PX4 writes to be found behind damage."""

FIELD_TYPES = {
    **{f"{sign}int{8 * n}_t": f"<{sign or 'i'}{n}" for n in (1, 2, 4, 8) for sign in ("", "u")},
    **{"float": "<f4", "double": "<f8", "bool": "i1", "char": "i1"},
}
"""NumPy type of each type of a field."""

LARGEST = 0xFFFF
"""Bytes of the largest message: no format can be larger."""

DEEPEST = 8
"""How deep formats may contain formats."""


@dataclass
class _Subscription:
    """One topic and instance: its fields, the sizes of its messages, where they are."""

    name: str
    instance: int
    dtype: np.dtype[np.void]
    sizes: range
    places: list[int] = field(default_factory=list)

    def columns(self, data: mmap.mmap) -> dict[str, Column]:
        end = DATA_HEADER + self.dtype.itemsize
        rows = b"".join(data[at + DATA_HEADER : at + end] for at in self.places)
        table = np.frombuffer(rows, dtype=self.dtype)
        return {name: table[name] for name in self.dtype.names or ()}


def title_of(log: Log) -> str:
    """Return which board and firmware wrote a log."""
    words = [str(log.facts.get("sys_name", "PX4"))]
    release = log.facts.get("ver_sw_release")
    if isinstance(release, int) and release:
        words.append("v" + ".".join(str(release >> shift & 0xFF) for shift in (24, 16, 8)))
    elif "ver_sw" in log.facts:
        words.append(f"firmware {str(log.facts['ver_sw'])[:10]}")
    if "ver_hw" in log.facts:
        words.append(f"on {log.facts['ver_hw']}")
    return " ".join(words)


def read_ulog(path: Path) -> Log:
    """Read a ULog file.

    Raises
    ------
    ImportLogError
        If the file cannot be read.
    """
    log = Log(path)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if len(data) < FILE_HEADER:
                raise ImportLogError(f"log '{path}' is no readable ULog file: it is cut off")
            log.start_ns = int.from_bytes(data[8:16], "little") * NS_PER_US
            found = _Walker(data, log)
            gaps = walk(found, FILE_HEADER, len(data))
            stamped: list[tuple[int, int]] = []
            for topic in found.topics.values():
                if "timestamp" in (topic.dtype.names or ()) and topic.places:
                    columns = topic.columns(data)
                    good = log.add(topic.name, topic.instance, columns)
                    t_ns = columns["timestamp"][good].astype(np.int64) * NS_PER_US
                    places = np.array(topic.places)[good]
                    stamped += zip(places.tolist(), t_ns.tolist(), strict=True)
            cut = bool(gaps) and gaps[-1][1] == len(data) and found.may_begin(gaps[-1][0])
            log.say_loss(gaps, len(data), stamped, cut=cut)
    except OSError as error:
        raise ImportLogError(f"log '{path}' cannot be read: {error.strerror}") from None
    if lost := log.dropouts:
        log.findings.doubt(
            f"the logger lost messages {len(lost)} times, together {sum(lost):.3g} s, at most "
            f"{max(lost):.3g} s (dropouts)"
        )
    return log


_FORMAT = re.compile(rb"[\w/]+:[\w/ ;\[\]]*")
_KEY = re.compile(rb"[a-z0-9_]+(\[\d+\])? [\w-]+")


class _Walker:
    """Finds the messages of a file, and takes them into a log."""

    def __init__(self, data: mmap.mmap, log: Log) -> None:
        self._data, self._size, self._log = data, len(data), log
        self.topics: dict[int, _Subscription] = {}
        self.lengths: set[int] = set()
        self._formats: dict[str, list[tuple[str, int, str]]] = {}
        self._newest: _Subscription | None = None
        self._last: _Subscription | None = None
        self._known: dict[str, Callable[[int, int], bool]] = {
            "B": lambda at, size: size == 40,
            "F": lambda at, size: _FORMAT.fullmatch(data, at, at + size) is not None,
            "I": self._has_key,
            "M": lambda at, size: self._has_key(at + 1, size - 1),
            "P": self._has_key,
            "Q": lambda at, size: self._has_key(at + 1, size - 1),
            "A": lambda at, size: _text(data[at + 3 : at + size]) in self._formats,
            "D": self._is_sample,
            "S": lambda at, size: data[at : at + size] == SYNC,
            "L": lambda at, size: size >= 9,
            "C": lambda at, size: size >= 11,
            "R": lambda at, size: size == 2,
            "O": lambda at, size: size == 2,
        }
        self._certain = re.compile(b"[FIMPQADS]")
        self._takers = {
            "B": self._take_flags,
            "F": self._take_format,
            "I": self._take_fact,
            "P": self._take_parameter,
            "A": self._take_topic,
            "O": self._take_dropout,
        }

    # -- what a message is -------------------------------------------------------------------

    def _header(self, at: int) -> tuple[int, str]:
        size, kind = struct.unpack("<HB", self._data[at : at + MESSAGE_HEADER])
        return size, chr(kind)

    def may_begin(self, at: int) -> bool:
        """Whether a message may begin here of which the file holds a part only."""
        if at + MESSAGE_HEADER > self._size:
            return True
        size, kind = self._header(at)
        return kind in self._known and at + MESSAGE_HEADER + size > self._size

    def length(self, at: int) -> int:
        if at + MESSAGE_HEADER > self._size:
            return 0
        size, kind = self._header(at)
        end = at + MESSAGE_HEADER + size
        known = self._known.get(kind)
        if known is None or end > self._size or not known(at + MESSAGE_HEADER, size):
            return 0
        return MESSAGE_HEADER + size

    def next_certain(self, start: int) -> int:
        for found in self._certain.finditer(self._data, start + 2):
            at = found.start() - 2
            length = self.length(at)
            if length and (at + length == self._size or self.length(at + length)):
                return at
        return self._size

    def resembles(self, at: int) -> bool:
        if at + MESSAGE_HEADER > self._size:
            return False
        size, kind = self._header(at)
        return kind in self._known or size + MESSAGE_HEADER in self.lengths

    def _has_key(self, at: int, size: int) -> bool:
        """Whether a type, a name and a value of that type begin here."""
        count = self._data[at] if size > 0 else 0
        return count < size and _KEY.fullmatch(self._data, at + 1, at + 1 + count) is not None

    def _is_sample(self, at: int, size: int) -> bool:
        topic = self.topics.get(int.from_bytes(self._data[at : at + 2], "little"))
        return topic is not None and size - 2 in topic.sizes

    # -- what it says ------------------------------------------------------------------------

    def take(self, at: int) -> None:
        size, kind = self._header(at)
        begin = at + MESSAGE_HEADER
        self._last = None
        if kind == "D":
            self._last = self._newest = self.topics[
                int.from_bytes(self._data[begin : begin + 2], "little")
            ]
            self._last.places.append(at)
        elif kind in self._takers:
            self._takers[kind](self._data[begin : begin + size])

    def take_back(self) -> None:
        if self._last is not None:
            self._last.places.pop()

    def _take_flags(self, content: bytes) -> None:
        incompatible = content[8:16]
        if incompatible[0] & ~1 or any(incompatible[1:]):
            raise ImportLogError(
                f"log '{self._log.path}' is no readable ULog file: its flags "
                f"{incompatible.hex()} say that it is of a later format"
            )

    def _take_format(self, content: bytes) -> None:
        name, _, declared = content.decode().partition(":")
        fields = []
        for entry in filter(None, declared.split(";")):
            found = re.fullmatch(r"(\w+)(?:\[(\d{1,5})\])? (\w+)", entry)
            if found is None:
                return
            fields.append((found[1], int(found[2] or 0), found[3]))
        self._formats.setdefault(name, fields)

    def _take_topic(self, content: bytes) -> None:
        number, name = int.from_bytes(content[1:3], "little"), _text(content[3:])
        try:
            fields = list(self._flat(name, "", 0, [0]))
            padding = 0
            while fields and fields[-1][0].startswith("_padding"):
                padding += np.dtype(fields.pop()[1]).itemsize
            dtype = np.dtype(fields)
        except ValueError:  # formats that contradict each other
            return
        sizes = range(dtype.itemsize, dtype.itemsize + padding + 1)
        self.topics.setdefault(number, _Subscription(name, content[0], dtype, sizes))
        self.lengths.update(size + DATA_HEADER for size in (sizes[0], sizes[-1]))

    def _flat(
        self, name: str, prefix: str, depth: int, total: list[int]
    ) -> Iterator[tuple[str, str]]:
        """Yield names and NumPy types of a format's fields, those of formats in it one by one."""
        if depth > DEEPEST or not self._formats.get(name):
            raise ValueError(name)
        for kind, count, entry in self._formats[name]:
            for i in range(max(count, 1)):
                full = f"{prefix}{entry}[{i}]" if count else f"{prefix}{entry}"
                if kind in FIELD_TYPES:
                    total[0] += np.dtype(FIELD_TYPES[kind]).itemsize
                    if total[0] > LARGEST:
                        raise ValueError(name)
                    yield full, FIELD_TYPES[kind]
                else:
                    yield from self._flat(kind, f"{full}.", depth + 1, total)

    def _take_fact(self, content: bytes) -> None:
        kind, name, value = _entry(content)
        if kind.startswith("char["):
            self._log.facts[name] = _text(value)
        elif (number := _number(kind, value)) is not None:
            self._log.facts[name] = number

    def _take_parameter(self, content: bytes) -> None:
        kind, name, content = _entry(content)
        value = _number(kind, content)
        if value is None:
            return
        t_us = 0
        if self._newest is not None:
            place: Mapping[str, Any] = self._newest.dtype.fields or {}
            at = self._newest.places[-1] + DATA_HEADER + int(place["timestamp"][1])
            t_us = int.from_bytes(self._data[at : at + 8], "little")
        self._log.set_parameter(name, value, t_us * 1e-6)

    def _take_dropout(self, content: bytes) -> None:
        self._log.dropouts.append(int.from_bytes(content, "little") * 1e-3)


def _entry(content: bytes) -> tuple[str, str, bytes]:
    end = 1 + content[0]
    kind, _, name = _text(content[1:end]).partition(" ")
    return kind, name, content[end:]


def _number(kind: str, value: bytes) -> int | float | None:
    """Return the number that some bytes are; None if they are none of this type."""
    dtype = np.dtype(FIELD_TYPES.get(kind, "V"))
    if dtype.kind == "V" or len(value) != dtype.itemsize:
        return None
    number: int | float = np.frombuffer(value, dtype)[0].item()
    return number


def _text(content: bytes) -> str:
    return content.decode(errors="replace").rstrip("\0")
