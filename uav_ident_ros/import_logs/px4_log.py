# SPDX-License-Identifier: Apache-2.0
"""A PX4 log (ULog, or its tables): topics as arrays, parameters, what is damaged.

The format describes itself, by https://docs.px4.io/main/en/dev_log/ulog_file_format: behind a
header of 16 bytes every message begins with its size and a letter for its type. F declares a
format, A a topic of it, P a parameter, I a fact; D is a sample of a topic.
"""

import mmap
import re
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.import_logs.flight_log import ImportLogError
from uav_ident_ros.import_logs.log import BinaryLog, Column, Gap, Log, Places, Records, read_binary
from uav_ident_ros.messages.types import NS_PER_US

MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
"""First bytes of every ULog file."""

FILE_HEADER, MESSAGE_HEADER = 16, 3
"""Bytes before the first message, and before what a message holds."""

HEADER = struct.Struct("<Hc")

SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
"""Content of the messages that PX4 writes to be found behind damage."""

FIELD_TYPES = {
    **{f"{sign}int{8 * n}_t": f"<{sign or 'i'}{n}" for n in (1, 2, 4, 8) for sign in ("", "u")},
    **{"float": "<f4", "double": "<f8", "bool": "i1", "char": "i1"},
}
"""NumPy type of each type of a field."""

FORMS = {
    b"B": re.compile(b".{40}", re.DOTALL),
    b"F": re.compile(rb"[\w/]+:[\w/ ;\[\]]*"),
    b"S": re.compile(re.escape(SYNC)),
    b"L": re.compile(b".{9,}", re.DOTALL),
    b"C": re.compile(b".{11,}", re.DOTALL),
    b"R": re.compile(b"..", re.DOTALL),
    b"O": re.compile(b"..", re.DOTALL),
}
"""What the messages of a type hold, where that has a form of its own."""

KEYS = {b"I": 0, b"P": 0, b"M": 1, b"Q": 1}
"""Where the key of a value begins, by the type of the messages."""

KEY = re.compile(rb"[a-z0-9_]+(\[\d+\])? [\w-]+")

LARGEST = 0xFFFF
"""Bytes of the largest message: no format can be larger."""

DEEPEST = 8
"""How deep formats may contain formats."""


def read_ulog(path: Path) -> Log:
    """Read a ULog file.

    Raises
    ------
    ImportLogError
        If the file cannot be read.
    """
    return read_binary(path, _Ulog, FILE_HEADER)


class _Ulog(BinaryLog):
    begins = re.compile(b"(?=..[FIMPQADS])", re.DOTALL)

    def __init__(self, data: mmap.mmap, log: Log) -> None:
        super().__init__(data, log)
        if self.size < FILE_HEADER:
            raise log.refusal(" is no readable ULog file: it is cut off")
        log.start_ns = int.from_bytes(data[8:16], "little") * NS_PER_US
        self._formats: dict[str, list[tuple[str, int, str]]] = {}
        self._topics: dict[int, Records] = {}
        self._newest: Records | None = None
        self._facts: dict[str, Any] = {}
        self._dropouts: list[float] = []  # s
        self._takers: dict[bytes, Callable[[bytes], object]] = {
            b"B": self._take_flags,
            b"F": self._take_format,
            b"I": self._take_fact,
            b"P": self._take_parameter,
            b"A": self._take_topic,
            b"O": lambda content: self._dropouts.append(int.from_bytes(content, "little") * 1e-3),
        }

    # -- what a message is -------------------------------------------------------------------

    def _header(self, at: int) -> tuple[int, bytes]:
        """Return the length of a message with its header, and its type."""
        if at + MESSAGE_HEADER > self.size:
            return self.size, b"\0"
        size, kind = HEADER.unpack_from(self.data, at)
        return MESSAGE_HEADER + size, kind

    def length(self, at: int) -> int:
        length, kind = self._header(at)
        begin, end = at + MESSAGE_HEADER, at + length
        return length if end <= self.size and self._is_known(kind, begin, end) else 0

    def resembles(self, at: int) -> bool:
        length, kind = self._header(at)
        return kind in FORMS or kind in KEYS or kind in b"AD" or length in self.lengths

    def _is_known(self, kind: bytes, begin: int, end: int) -> bool:
        data = self.data
        if kind == b"D":
            topic = self._topics.get(int.from_bytes(data[begin : begin + 2], "little"))
            return topic is not None and end - begin + MESSAGE_HEADER in topic.sizes
        if kind in FORMS:
            return FORMS[kind].fullmatch(data, begin, end) is not None
        if kind in KEYS:
            begin += KEYS[kind]
            key_end = begin + 1 + data[begin] if begin < end else end
            return key_end < end and KEY.fullmatch(data, begin + 1, key_end) is not None
        return kind == b"A" and _text(data[begin + 3 : end]) in self._formats

    # -- what it says ------------------------------------------------------------------------

    def take(self, at: int, length: int) -> Places | None:
        kind, begin = self.data[at + 2 : at + 3], at + MESSAGE_HEADER
        if kind == b"D":
            number = int.from_bytes(self.data[begin : begin + 2], "little")
            self._newest = self._topics[number]
            return self._newest.places
        if kind in self._takers:
            self._takers[kind](self.data[begin : at + length])
        return None

    def finish(self, gaps: list[Gap]) -> bool:
        for topic in self._topics.values():
            if "timestamp" in (topic.dtype.names or ()) and topic.places:
                self.keep(topic)
        self.log.title = _title(self._facts)
        if lost := self._dropouts:
            self.log.findings.doubt(
                f"the logger lost messages {len(lost)} times, together {sum(lost):.3g} s, at most "
                f"{max(lost):.3g} s (dropouts)"
            )
        if not gaps:
            return False
        begin, end = gaps[-1]
        length, kind = self._header(begin)
        part = begin + length > self.size and (kind in FORMS or kind in KEYS or kind in b"AD")
        return end == self.size and (part or begin + MESSAGE_HEADER > self.size)

    def _take_flags(self, content: bytes) -> None:
        incompatible = content[8:16]
        if incompatible[0] & ~1 or any(incompatible[1:]):
            raise ImportLogError(
                f"log '{self.log.path}' is no readable ULog file: its flags "
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
        padding = 0
        try:
            fields = list(self._flat(name, "", 0, [0]))
            while fields and fields[-1][0].startswith("_padding"):
                padding += np.dtype(fields.pop()[1]).itemsize
            dtype = np.dtype([("", "V5"), *fields])
        except ValueError:  # formats that contradict each other
            return
        sizes = range(dtype.itemsize, dtype.itemsize + padding + 1)
        self._topics.setdefault(number, Records(name, dtype, (), content[0], sizes))
        self.lengths.update((sizes[0], sizes[-1]))

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
        fact = _text(value) if kind.startswith("char[") else _number(kind, value)
        if fact is not None:
            self._facts[name] = fact

    def _take_parameter(self, content: bytes) -> None:
        kind, name, content = _entry(content)
        value, t_us = _number(kind, content), 0
        if self._newest is not None and self._newest.places:
            place: Mapping[str, Any] = self._newest.dtype.fields or {}
            at = self._newest.places[-1] + int(place["timestamp"][1])
            t_us = int.from_bytes(self.data[at : at + 8], "little")
        if value is not None:
            self.log.set_parameter(name, value, t_us * 1e-6)


def _title(facts: Mapping[str, Any]) -> str:
    """Return which board and firmware wrote a log."""
    words = [str(facts.get("sys_name", "PX4"))]
    release = facts.get("ver_sw_release")
    if isinstance(release, int) and release:
        words.append("v" + ".".join(str(release >> shift & 0xFF) for shift in (24, 16, 8)))
    elif "ver_sw" in facts:
        words.append(f"firmware {str(facts['ver_sw'])[:10]}")
    if "ver_hw" in facts:
        words.append(f"on {facts['ver_hw']}")
    return " ".join(words)


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


# --- tables of ulog2csv --------------------------------------------------------------------------

TABLE = re.compile(r"(?P<log>.+?)_(?P<topic>{topics})_(?P<instance>\d+)\.csv")
"""How ulog2csv names its files."""

PARAMETERS = re.compile(r".*param(s|eters)?\.(csv|txt)")
"""What ulog_params writes: lines of a name and a value."""


def read_folder(path: Path, topics: Collection[str]) -> Log:
    """Read the tables of some topics, and the parameters if they are there.

    Raises
    ------
    ImportLogError
        If there is none of them, there are those of several logs, or one cannot be read.
    """
    pattern = re.compile(TABLE.pattern.replace("{topics}", "|".join(map(re.escape, topics))))
    found = {file: match for file in sorted(path.iterdir())
             if (match := pattern.fullmatch(file.name))}  # fmt: skip
    logs = sorted({match["log"] for match in found.values()})
    if len(logs) != 1:
        raise ImportLogError(
            f"folder '{path}' has the tables of several logs, {', '.join(logs)}: give each its own"
            if logs
            else f"folder '{path}' has no table of ulog2csv, as LOG_sensor_combined_0.csv"
        )
    log = Log(path, "PX4, by ulog2csv")
    for file, match in found.items():
        columns = _table(file)
        if len(columns["timestamp"]):
            log.add(match["topic"], int(match["instance"]), columns)
    for file in path.iterdir():
        if PARAMETERS.fullmatch(file.name.lower()):
            log.parameters.update(_parameters(file))
    if not log.parameters:
        log.findings.doubt(
            "the tables say nothing of the parameters: ulog_params LOG.ulg PARAMS.csv writes them"
        )
    return log


def _table(file: Path) -> dict[str, Column]:
    try:
        with file.open(encoding="utf-8") as text:
            names = text.readline().strip().split(",")
            values = np.loadtxt(text, delimiter=",", ndmin=2).reshape(-1, len(names))
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ImportLogError(f"table '{file}' cannot be read: {reason}") from None
    if "timestamp" not in names:
        raise ImportLogError(f"table '{file}' has no column 'timestamp'")
    return dict(zip(names, values.T, strict=True))


def _parameters(file: Path) -> dict[str, float]:
    """Return the parameters of lines such as ``CA_AIRFRAME,1``."""
    text = file.read_text("utf-8", errors="replace")
    number = r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?"
    found = re.findall(rf"(?m)^\s*(\w+)[,:\s]+({number})\s*(?:,|$)", text)
    return {name: float(value) for name, value in found}
