# SPDX-License-Identifier: Apache-2.0
"""Write rosbag2 bags in MCAP, with schemas and QoS, the same bytes for the same messages."""

from __future__ import annotations

import dataclasses
import heapq
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    StoragePlugin,
    Writer,
    WriterError,
)
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from uav_ident_ros.messages.types import NS_PER_S

FOREVER = QosTime(2147483647, 4294967295)
"""Infinite duration, as rosbag2 writes it."""


class BagWriteError(Exception):
    """A bag cannot be written; the message names the path or topic and why."""


@contextmanager
def whole(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Give a place for a file or a folder, which takes that of `path` once it is whole.

    Nothing half-written stays behind; the folder that it is in is made.

    Raises
    ------
    BagWriteError
        If it cannot be written, or is a folder that is there already and not to be replaced.
    """
    if path.is_dir() and not replace:
        raise BagWriteError(f"{path} exists already, not overwriting.")
    working = path.parent / f".{path.name}.part"
    shutil.rmtree(working, ignore_errors=True)
    try:
        working.mkdir(parents=True)
        yield working / path.name
        if path.is_dir():
            shutil.rmtree(path)
        (working / path.name).replace(path)
    except OSError as error:
        raise BagWriteError(f"cannot write '{path}': {error.strerror}") from None
    finally:
        shutil.rmtree(working, ignore_errors=True)


def write_file(path: Path, text: str) -> None:
    """Write a text file, whole or not at all; raises as `whole` does."""
    with whole(path) as part:
        part.write_text(text, encoding="utf-8")


def qos(
    depth: int = 10,  # Depth of the history
    *,
    reliable: bool = True,  # Reliable, or best effort
    transient_local: bool = False,  # Keeps its last messages for late subscribers, or is volatile
) -> Qos:
    """QoS profile that a topic was offered with."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if transient_local else QosDurability.VOLATILE,
        deadline=FOREVER,
        lifespan=FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=FOREVER,
        avoid_ros_namespace_conventions=False,
    )


@cache
def jazzy_types() -> Typestore:
    """Message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def message_class(msgtype: str) -> Any:
    """Return the class of a message type such as ``sensor_msgs/msg/Imu``.

    Raises
    ------
    BagWriteError
        If ROS 2 Jazzy's common interfaces have no such type.
    """
    try:
        return jazzy_types().types[msgtype]
    except KeyError:
        raise BagWriteError(f"message type '{msgtype}' is not among ROS 2 Jazzy's") from None


def stamp(t_ns: int) -> Any:
    """builtin_interfaces/msg/Time of a time in ns."""
    return message_class("builtin_interfaces/msg/Time")(
        sec=int(t_ns) // NS_PER_S, nanosec=int(t_ns) % NS_PER_S
    )


class BagWriter:
    """Writes one rosbag2 folder with an MCAP file; a context manager.

    Messages are written in the order of the calls; give them in log-time order. A bag whose
    block ends with an exception is left without metadata, as an interrupted recording is.

    Examples
    --------
    >>> with BagWriter("flight") as bag:                                  # doctest: +SKIP
    ...     bag.topic("/data", "std_msgs/msg/Float64MultiArray", qos=qos(10))
    ...     bag.write("/data", 0, message)
    """

    def __init__(
        self,
        path: Path | str,  # Folder of the new bag; must not exist
        compress: bool = False,  # Compress the chunks with zstd
        # Message types, for bags with types outside of ROS 2 Jazzy's own
        typestore: Typestore | None = None,
    ) -> None:
        self.path = Path(path)
        self.types = typestore or jazzy_types()
        self._topics: dict[str, Connection] = {}
        try:
            self._writer = Writer(
                self.path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP
            )
        except WriterError as error:
            raise BagWriteError(str(error)) from None
        if compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def __enter__(self) -> BagWriter:
        """Create the folder and open the file."""
        try:
            self._writer.open()
        except (WriterError, OSError) as error:
            raise BagWriteError(f"cannot write bag '{self.path}': {error}") from None
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write index and metadata; after an exception leave the bag unfinished."""
        if kind is None:
            self._writer.close()
        else:
            self._writer.abort()

    def topic(
        self,
        name: str,  # Topic name
        msgtype: str,  # Message type, ``package/msg/Name``
        qos: Qos | None = None,  # Profile it was offered with; see `qos`
    ) -> None:
        """Announce a topic.

        Raises
        ------
        BagWriteError
            If it was announced before or its type is unknown.
        """
        if name in self._topics:
            raise BagWriteError(f"topic '{name}' of bag '{self.path}' is announced twice")
        if msgtype not in self.types.types:
            raise BagWriteError(f"topic '{name}': message type '{msgtype}' is unknown")
        self._topics[name] = self._writer.add_connection(
            name, msgtype, typestore=self.types, offered_qos_profiles=(qos,) if qos else ()
        )

    def write(
        self,
        topic: str,  # An announced topic
        log_time_ns: int,  # Log time, ns
        # Message as a dataclass of the typestore (see `message_class`), or its CDR bytes
        message: Any,
    ) -> None:
        """Write one message.

        Raises
        ------
        BagWriteError
            If the topic was not announced.
        """
        connection = self._topics.get(topic)
        if connection is None:
            raise BagWriteError(
                f"topic '{topic}' of bag '{self.path}' was not announced; announced are "
                f"{', '.join(self._topics) or 'none'}"
            )
        if dataclasses.is_dataclass(message):
            message = self.types.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, int(log_time_ns), message)

    def merge(self, streams: Iterable[Iterable[tuple[int, str, Any]]]) -> None:
        """Write the messages of streams, each in the order of its log times, by their log times.

        At equal times the earlier stream comes first: actuators before rates, as the command
        precedes its effect. Parameters of each message, and errors, as of `write`.
        """
        for log_ns, topic, message in heapq.merge(*streams, key=itemgetter(0)):
            self.write(topic, log_ns, message)
