# SPDX-License-Identifier: Apache-2.0
"""Reader of PX4 logs (ULog, or tables of ulog2csv): topics as arrays, parameters, damage.

pyulog fails behind damaged bytes: it receives only the messages that are certain. A header of 16
bytes precedes the messages, and each begins with its size and a letter for its type. F declares a
format, A a topic of it, P a parameter, I a fact; D is a sample of a topic, O a dropout of the
logger (https://docs.px4.io/main/en/dev_log/ulog_file_format).
"""

import contextlib
import io
import re
import struct
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.import_logs.binary import CUT_OFF, BinaryLog
from uav_ident_ros.import_logs.log import Column, ImportLogError, Log

MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
"""First bytes of every ULog file."""

FILE_HEADER, MESSAGE_HEADER, FLAGS = 16, 3, 40
"""Bytes of the file's header, of a message's header, and of the body of the flags' message."""

HEADER_LAYOUT = struct.Struct("<Hc")

SIZES = {
    **{f"{sign}int{8 * n}_t": n for n in (1, 2, 4, 8) for sign in ("", "u")},
    **{"float": 4, "double": 8, "bool": 1, "char": 1},
}
"""Size of each type of field, bytes."""

READ, UNREAD = frozenset("FAPIDO"), frozenset("SLCRMQ")
"""Types of messages: those in use, and unused marks, texts and values."""

KEY = re.compile(rb"([a-z0-9_]+(?:\[\d+\])?) [\w-]+")
FORMAT_TEXT = re.compile(r"([\w/]+):((?:[\w/]+(?:\[\d{1,5}\])? \w+;)*)", re.ASCII)
FIELD = re.compile(r"([\w/]+)(?:\[(\d+)\])? (\w+);")

LARGEST = 0xFFFF
"""Size of the largest message, bytes: no format is larger."""

DEEPEST = 8
"""Deepest nesting of formats."""


def read_ulog(path: Path, topics: Collection[str]) -> Log:
    """Read some topics, the parameters and the facts of a ULog file."""
    log, data = Log(path), path.read_bytes()
    try:
        from pyulog import ULog
    except ImportError:
        raise log.lacks("pyulog", "PX4's logs", "import_log", "pyulog>=1.1") from None
    if len(data) < FILE_HEADER:
        raise log.refusal(" is no readable ULog file: it is cut off")
    found, start = _Ulog(data), FILE_HEADER
    if found.header(start) == (MESSAGE_HEADER + FLAGS, "B"):
        start += MESSAGE_HEADER + FLAGS
        incompatible = data[start - FLAGS + 8 :][:8]
        if incompatible[0] & ~1 or any(incompatible[1:]):
            raise log.refusal(
                f" is no readable ULog file: its flags {incompatible.hex()} say that it is of a "
                "later format"
            )
    places, gaps = found.walk(start)
    pieces = [data[at : at + found.header(at)[0]] for at in places if chr(data[at + 2]) in READ]
    whole = io.BytesIO(b"".join([data[:FILE_HEADER], *pieces]))
    numbers = {data[at + 3 : at + 5] for at in places if data[at + 2] == ord("D")}
    log.kinds = {found.topics[int.from_bytes(number, "little")] for number in numbers}
    with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints
        ulog = ULog(whole, sorted(found.stamped & {*topics}))
    for topic in ulog.data_list:
        log.add(topic.name, topic.data, topic.multi_id)
    first = [(0, name, value) for name, value in ulog.initial_parameters.items()]
    for t_us, name, value in first + ulog.changed_parameters:
        if isinstance(value, int | float):
            log.set_parameter(name, value, t_us * 1e-6)
    log.title = _title(ulog.msg_info_dict)
    if lost := [dropout.duration * 1e-3 for dropout in ulog.dropouts]:
        log.findings.lost.append(
            f"the logger lost messages {len(lost)} times, together {sum(lost):.3g} s, at most "
            f"{max(lost):.3g} s (dropouts)"
        )
    found.note_loss(log, gaps)
    return log


class _Ulog(BinaryLog):
    begins = re.compile(b"(?=..[FAPID])", re.DOTALL)

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.topics: dict[int, str] = {}  # Name by the number in the samples
        self.stamped: set[str] = set()  # Names of formats with a stamp
        self._formats: dict[str, str] = {}  # Fields of formats, by name
        self._sizes: dict[int, int] = {}  # Length of the samples' messages, by number

    def header(self, at: int) -> tuple[int, str]:
        """Return the length of a message with its header, and its type."""
        if at + MESSAGE_HEADER > self.size:
            return self.size, ""
        size, kind = HEADER_LAYOUT.unpack_from(self.data, at)
        return MESSAGE_HEADER + size, kind.decode("latin-1")

    def length(self, at: int) -> int:
        length, kind = self.header(at)
        begin, end = at + MESSAGE_HEADER, at + length
        return length if end <= self.size and self._is_known(kind, begin, end) else 0

    def rest(self, at: int) -> str | None:
        length, kind = self.header(at)
        part = kind in READ | UNREAD and at + length > self.size
        return CUT_OFF if part or at + MESSAGE_HEADER > self.size else None

    def register(self, at: int, length: int) -> None:
        begin, end, kind = at + MESSAGE_HEADER, at + length, self.data[at + 2]
        if kind == ord("F"):
            name, _, fields = self.data[begin:end].decode().partition(":")
            self._formats[name] = fields
            if "uint64_t timestamp" in fields.split(";"):
                self.stamped.add(name)
        elif kind == ord("A"):
            number, name = self._topic(begin, end)
            self.topics[number] = name
            self._sizes[number] = MESSAGE_HEADER + 2 + self._size(name, outer=True)

    def _is_known(self, kind: str, begin: int, end: int) -> bool:
        """Return whether a message has the form of its type, and contradicts none before it."""
        data = self.data
        if kind == "D":
            number = int.from_bytes(data[begin : begin + 2], "little")
            return self._sizes.get(number) == end - begin + MESSAGE_HEADER
        if kind in "IP":
            value = begin + 1 + data[begin] if begin < end else end
            key = KEY.fullmatch(data, begin + 1, value) if value < end else None
            return key is not None and SIZES.get(key[1].decode(), end - value) == end - value
        if kind == "F":
            form = FORMAT_TEXT.fullmatch(data[begin:end].decode("latin-1"))
            return form is not None and self._formats.get(form[1], form[2]) == form[2]
        if kind == "A" and end - begin > 3:
            number, name = self._topic(begin, end)
            return number not in self.topics and 0 < self._size(name, outer=True) <= LARGEST
        return kind in UNREAD or (kind == "O" and end - begin == 2)

    def _topic(self, begin: int, end: int) -> tuple[int, str]:
        """Return the declared number and name of a topic."""
        number, name = self.data[begin + 1 : begin + 3], self.data[begin + 3 : end]
        return int.from_bytes(number, "little"), name.decode("latin-1")

    def _size(self, name: str, outer: bool = False, depth: int = 0) -> int:
        """Return the size of a format with nested ones, bytes; 0 or above `LARGEST` if invalid.

        The log leaves out the padding at the end of the outer format.
        """
        fields = FIELD.findall(self._formats.get(name, ""))
        while outer and fields and fields[-1][2].startswith("_padding"):
            fields.pop()
        size = 0
        for kind, count, _ in fields:
            each = SIZES.get(kind) or (self._size(kind, depth=depth + 1) if depth < DEEPEST else 0)
            size += max(int(count or 1), 1) * (each or LARGEST + 1)
            if size > LARGEST:
                break
        return size


def _title(facts: Mapping[str, Any]) -> str:
    """Return the firmware, its version and the board of a log."""
    parts = [str(facts.get("sys_name", "PX4"))]
    release = facts.get("ver_sw_release")
    if isinstance(release, int) and release:
        parts.append("v" + ".".join(str(release >> shift & 0xFF) for shift in (24, 16, 8)))
    elif "ver_sw" in facts:
        parts.append(f"firmware {str(facts['ver_sw'])[:10]}")
    if "ver_hw" in facts:
        parts.append(f"on {facts['ver_hw']}")
    return " ".join(parts)


# --- tables of ulog2csv --------------------------------------------------------------------------


def read_folder(path: Path, topics: Collection[str]) -> Log:
    """Read the tables of some topics, and the parameters if present."""
    pattern = re.compile(
        rf"(?P<log>.+?)_(?P<topic>{'|'.join(map(re.escape, topics))})_(?P<instance>\d+)\.csv"
    )
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
            log.add(match["topic"], columns, int(match["instance"]))
    for file in path.glob("*params.csv"):  # of ulog_params: names and values
        try:
            lines = filter(str.strip, file.read_text(encoding="utf-8").splitlines())
            rows = (line.partition(",") for line in lines)
            log.parameters |= {name: float(rest.partition(",")[0]) for name, _, rest in rows}
        except ValueError as error:
            raise ImportLogError(
                f"table '{file}' cannot be read: each line needs a name and a number ({error})"
            ) from None
    if not log.parameters:
        log.findings.lost.append(
            "the tables do not have the parameters: ulog_params LOG.ulg params.csv writes them"
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
