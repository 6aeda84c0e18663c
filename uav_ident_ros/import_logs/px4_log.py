# SPDX-License-Identifier: Apache-2.0
"""A PX4 log file, opened with pyulog: topics as arrays, parameters, what is damaged."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import NS_PER_US, Column, ImportLogError
from uav_ident_ros.import_logs.stamps import rate

MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
"""First bytes of every ULog file."""

MESSAGE_HEADER = 3
"""Bytes before each message: its size and its type."""


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
        stamps = self._data[field if field in self._data else "timestamp"]
        return np.asarray(stamps, dtype=np.int64) * NS_PER_US

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

    Raises
    ------
    ImportLogError
        If pyulog is missing or the file is none that it can read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ulog, self.damage = _load(path)
        self.parameters: dict[str, float] = dict(self._ulog.initial_parameters)
        self._topics = {(d.name, d.multi_id): d for d in self._ulog.data_list}

    def topic(self, name: str, instance: int = 0) -> Topic | None:
        """Return a topic if the log has messages of it."""
        data = self._topics.get((name, instance))
        if data is None or not len(data.data["timestamp"]):
            return None
        return Topic(f"{name}[{instance}]" if instance else name, data.data)

    def instances(self, name: str) -> list[int]:
        """Instances of a topic that have messages."""
        return sorted(i for n, i in self._topics if n == name and self.topic(n, i) is not None)

    def contents(self) -> str:
        """List the topics in one line."""
        return ", ".join(sorted({name for name, _ in self._topics})) or "no topics at all"

    @property
    def end_ns(self) -> int:
        """Newest stamp, ns."""
        return int(self._ulog.last_timestamp) * NS_PER_US

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
    """A file for reading that remembers whether it ended in the middle of a message."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.cut = False

    def read(self, size: int) -> bytes:
        data: bytes = self._file.read(size)
        at_the_end = not data and size == MESSAGE_HEADER
        self.cut |= len(data) < size and not at_the_end
        return data

    def seek(self, *arguments: int) -> int:
        return int(self._file.seek(*arguments))

    def tell(self) -> int:
        return int(self._file.tell())

    def close(self) -> None:
        self._file.close()


def _load(path: Path) -> tuple[Any, list[str]]:
    """Parse a file; return pyulog's object and what is damaged."""
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
    except OSError as error:
        raise ImportLogError(f"log '{path}' cannot be read: {error.strerror}") from None
    except Exception as error:
        # Damaged bytes make a parser fail in many ways, beyond the library's own exceptions.
        raise ImportLogError(f"log '{path}' is no readable ULog file: {error}") from error
    damage = []
    if ulog.file_corruption:
        damage.append("the file is damaged inside: pyulog left out what it could not read")
    elif watched.cut:
        damage.append("the file is cut off at its end: what is there was read")
    return ulog, damage
