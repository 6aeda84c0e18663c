# SPDX-License-Identifier: Apache-2.0
"""A PX4 log file, opened with pyulog: topics as arrays, parameters, what is damaged."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import NS_PER_US, Column, ImportLogError
from uav_ident_ros.import_logs.stamps import plausible, rate

MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
"""First bytes of every ULog file."""

FILE_HEADER = 16
"""Bytes before the first message."""

MESSAGE_HEADER = 3
"""Bytes before each message: its size and its type."""

DATA_MESSAGE, OTHER_MESSAGES = ord("D"), b"BFIMPQARLCSO"
"""Types of the messages."""

CUT_OFF = "the file is cut off at its end: what is there was read"


class Topic:
    """All messages of one topic and instance.

    Parameters
    ----------
    name : str
        Name, with ``[i]`` behind it for an instance beyond the first.
    data : mapping
        Arrays by field name, as pyulog gives them.
    """

    def __init__(self, name: str, data: Any) -> None:
        self.name = name
        self._data = data

    def __contains__(self, field: str) -> bool:
        """Whether it has such a field."""
        return field in self._data

    @property
    def stamp_ns(self) -> TimeArray:
        """When the messages were published, ns since the start of the autopilot."""
        return self._ns("timestamp")

    @property
    def sample_ns(self) -> TimeArray:
        """When what they are computed from was sampled, ns; the publication if not logged."""
        sampled, published = self._ns("timestamp_sample"), self._ns("timestamp")
        return np.where(sampled > 0, sampled, published)

    @property
    def publication_delay(self) -> float | None:
        """Median time from sampling to publication, s; None if it is not logged."""
        if "timestamp_sample" not in self._data:
            return None
        return float(np.median(self._ns("timestamp") - self.sample_ns)) * 1e-9

    def _ns(self, field: str) -> TimeArray:
        return _in_ns(self._data[field if field in self._data else "timestamp"])

    @property
    def rate(self) -> float:
        """Messages per second."""
        return rate(self.stamp_ns)

    def column(self, field: str) -> Column:
        """Values of one field, in the type of the log."""
        return np.asarray(self._data[field])

    def vector(self, field: str, size: int = 3) -> FloatArray:
        """Values of an array field, shape (k, size)."""
        return np.column_stack([self.column(f"{field}[{i}]") for i in range(size)]).astype(float)

    def size(self, field: str) -> int:
        """Length of an array field."""
        return sum(1 for name in self._data if name.startswith(f"{field}["))


def _in_ns(t_us: Column) -> TimeArray:
    return np.asarray(t_us).astype(np.int64) * NS_PER_US


class Px4Log:
    """A PX4 log in memory.

    Parameters
    ----------
    path : Path
        ULog file.

    Attributes
    ----------
    parameters : dict
        Parameters at the start of the log, by name.
    damage : list of str
        What could not be read.
    remarks : list of str
        What else there is to say about the file.

    Raises
    ------
    ImportLogError
        If pyulog is missing or the file is none that it can read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ulog, self.damage, self.remarks = _load(path)
        self.parameters: dict[str, float] = {
            name: value
            for name, value in self._ulog.initial_parameters.items()
            if isinstance(value, int | float) and np.isfinite(value)
        }
        self._topics = {
            (d.name, d.multi_id): self._stamped(d.name, d.data)
            for d in self._ulog.data_list
            if "timestamp" in d.data
        }

    def topic(self, name: str, instance: int = 0) -> Topic | None:
        """Return a topic if the log has messages of it."""
        data = self._topics.get((name, instance))
        if data is None or not len(data["timestamp"]):
            return None
        return Topic(f"{name}[{instance}]" if instance else name, data)

    def _stamped(self, name: str, data: dict[str, Column]) -> dict[str, Column]:
        """Leave out the messages whose stamp no clock gave."""
        good = plausible(_in_ns(data["timestamp"]))
        if good.all():
            return data
        self.damage.append(
            f"{int((~good).sum())} of {len(good)} messages {name} have a stamp that no clock gave, "
            "and were left out"
        )
        return {field: values[good] for field, values in data.items()}

    def instances(self, name: str) -> list[int]:
        """Instances of a topic that have messages."""
        return sorted(i for n, i in self._topics if n == name and self.topic(n, i) is not None)

    def contents(self) -> str:
        """List the topics in one line."""
        return ", ".join(sorted({name for name, _ in self._topics})) or "no topics at all"

    @property
    def end_ns(self) -> int:
        """Newest stamp, ns."""
        newest = [
            data["timestamp"].max() for data in self._topics.values() if len(data["timestamp"])
        ]
        return int(max(newest, default=0)) * NS_PER_US

    @property
    def start_ns(self) -> int:
        """Stamp of the start of the log, ns."""
        return int(self._ulog.start_timestamp) * NS_PER_US

    @property
    def dropouts(self) -> list[float]:
        """Lengths of the stretches in which the logger itself lost messages, s."""
        return [dropout.duration * 1e-3 for dropout in self._ulog.dropouts]

    def changes(self, prefixes: tuple[str, ...]) -> Iterator[tuple[float, str, float]]:
        """Yield time (s), name and value of the parameters that were changed while logging."""
        for t_us, name, value in self._ulog.changed_parameters:
            if name.startswith(prefixes) and self.parameters.get(name) != value:
                yield t_us * 1e-6, name, value

    @property
    def title(self) -> str:
        """Which board and firmware wrote it."""
        info = self._ulog.msg_info_dict
        words = [str(info.get("sys_name", "PX4"))]
        release = info.get("ver_sw_release")
        if isinstance(release, int) and release:
            words.append("v" + ".".join(str(release >> shift & 0xFF) for shift in (24, 16, 8)))
        elif "ver_sw" in info:
            words.append(f"firmware {str(info['ver_sw'])[:10]}")
        if "ver_hw" in info:
            words.append(f"on {info['ver_hw']}")
        return " ".join(words)


class _Watched:
    """A file for reading that remembers which of its bytes became messages.

    Attributes
    ----------
    cut : bool
        Whether it ended in the middle of a message.
    understood : int
        Bytes of the file's header and of messages without data.
    data : dict
        Number and bytes of the data messages by the number of their topic.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self._message: tuple[int, int] | None = None
        self.cut = False
        self.understood = FILE_HEADER
        self.data: dict[int, tuple[int, int]] = {}

    def read(self, size: int) -> bytes:
        data: bytes = self._file.read(size)
        at_the_end = not data and size == MESSAGE_HEADER
        self.cut |= len(data) < size and not at_the_end
        message, self._message = self._message, None
        if message is not None and message[0] == size == len(data):
            self._take(message[1], data)
        elif size == len(data) == MESSAGE_HEADER:
            self._message = (int.from_bytes(data[:2], "little"), data[2])
        return data

    def _take(self, kind: int, data: bytes) -> None:
        if kind == DATA_MESSAGE:
            number = int.from_bytes(data[:2], "little")
            count, size = self.data.get(number, (0, 0))
            self.data[number] = (count + 1, size + MESSAGE_HEADER + len(data))
        elif kind in OTHER_MESSAGES:
            self.understood += MESSAGE_HEADER + len(data)

    def seek(self, *arguments: int) -> int:
        self._message = None
        return int(self._file.seek(*arguments))

    def tell(self) -> int:
        return int(self._file.tell())

    def close(self) -> None:
        """Leave the file open: its owner closes it."""

    def lost(self, topics: Collection[Any]) -> int:
        """Return how many bytes are in no message that pyulog has understood."""
        used = self.understood
        for topic in topics:
            count, size = self.data.get(topic.msg_id, (0, 0))
            used += round(size * min(len(topic.data["timestamp"]) / max(count, 1), 1.0))
        return int(self._file.seek(0, 2)) - used


def _load(path: Path) -> tuple[Any, list[str], list[str]]:
    """Parse a file; return pyulog's object, what is damaged and what else there is to say."""
    try:
        from pyulog import ULog  # type: ignore[import-untyped]
    except ImportError:
        raise ImportLogError(
            f"log '{path}': pyulog is not installed, which reads PX4 logs: "
            "pip install 'uav_ident_ros[px4]' or pip install pyulog"
        ) from None
    said = io.StringIO()
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(said):
            watched = _Watched(file)
            ulog = ULog(watched)
            size, lost = path.stat().st_size, watched.lost(ulog.data_list)
    except OSError as error:
        raise ImportLogError(f"log '{path}' cannot be read: {error.strerror}") from None
    except Exception as error:
        # Damaged bytes make a parser fail in many ways, beyond the library's own exceptions.
        raise ImportLogError(f"log '{path}' is no readable ULog file: {error}") from error
    if ulog.file_corruption:
        share = 100.0 * lost / size
        damage = f"the file is damaged: {lost} of {size} bytes ({share:.2g} %) could not be read"
        return ulog, [damage], []
    return ulog, [], [CUT_OFF] if watched.cut else []
