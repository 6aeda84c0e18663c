# SPDX-License-Identifier: Apache-2.0
"""Reader of MCAP files, rosbag2 folders and bags of ROS 1; messages are in log-time order."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as ReaderOfRos1
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uav_ident_ros.bags.limits import guard_rosbags
from uav_ident_ros.bags.salvage import SalvageError, SalvageReader
from uav_ident_ros.messages.types import listed

METADATA_FILE, SUFFIX_OF_ROS_1 = "metadata.yaml", ".bag"
STORAGE_SUFFIXES = (".mcap", ".db3", SUFFIX_OF_ROS_1)

PARSERS: dict[MessageDefinitionFormat, Callable[[str, str], dict[str, Any]]] = {
    MessageDefinitionFormat.MSG: get_types_from_msg,
    MessageDefinitionFormat.IDL: lambda text, _: get_types_from_idl(text),
}
"""Parser for each format of type definitions, from the text and the name of the type."""


def _register_type(store: Typestore, connection: Connection) -> None:
    """Register a bag's definition of a type, if it has one and the type is unknown."""
    definition, parse = connection.msgdef, PARSERS.get(connection.msgdef.format)
    if connection.msgtype in store.types or parse is None:
        return
    found = parse(definition.data, connection.msgtype)
    store.register({name: one for name, one in found.items() if name not in store.types})


guard_rosbags()

AnyReader: TypeAlias = Reader | SalvageReader | ReaderOfRos1


class BagError(Exception):
    """A bag cannot be read; the message names the bag or topic and the problem."""


class Message(NamedTuple):
    """One message of a bag."""

    topic: str
    log_ns: int  # Time of recording, ns
    data: bytes  # The serialized message (CDR)


class Bag:
    """A bag that is open for reading; a context manager.

    Raises
    ------
    BagError
        If there is no bag, or nothing of it can be read.

    Examples
    --------
    >>> with Bag("bags/flight") as bag:                                   # doctest: +SKIP
    ...     decode = bag.decoder("/imu/data")
    ...     for topic, log_ns, data in bag.messages(["/imu/data"]):
    ...         print(log_ns, decode(data).angular_velocity.x)
    """

    def __init__(
        self,
        # An MCAP file, or a rosbag2 folder, whose metadata file may be missing; or a bag of ROS 1
        path: Path | str,
    ) -> None:
        self.path = Path(path)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        # Defects of the bag and extent of the salvage, a line each; grows during reading
        self.damage: list[str] = []
        self._readers = _opened(self.path, self.damage)
        self._connections = [c for reader in self._readers for c in reader.connections]
        self.types: dict[str, str] = {}  # Message type of each topic, by name
        self.counts: Counter[str] = Counter()  # Number of messages of each topic
        for connection in sorted(self._connections, key=lambda connection: connection.topic):
            self.types.setdefault(connection.topic, connection.msgtype)
            self.counts[connection.topic] += connection.msgcount

    def __enter__(self) -> Bag:
        """Return the bag itself: it is open from the start."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the files."""
        for reader in self._readers:
            reader.close()

    @property
    def start_ns(self) -> int:
        """Log time of the first message, ns."""
        return min(reader.start_time for reader in self._readers)

    @property
    def end_ns(self) -> int:
        """Log time of the last message, ns."""
        return max(reader.end_time for reader in self._readers) - 1

    def type_of(self, topic: str) -> str:
        """Return the message type of a topic; raises `BagError` if the bag has no such topic."""
        try:
            return self.types[topic]
        except KeyError:
            raise BagError(
                f"bag '{self.path}' has no topic '{topic}'; it has {self.contents()}"
            ) from None

    def contents(self) -> str:
        """List the topics with their types in one line."""
        topics = [f"{topic} ({msgtype})" for topic, msgtype in self.types.items()]
        return listed(topics, "no topics at all")

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics in log-time order.

        Only a chunk of the bag is in memory at a time. At damaged parts reading continues behind
        them, and `damage` lists the loss.

        Raises
        ------
        BagError
            If a topic is missing, or nothing can be read.
        """
        for topic in topics:
            self.type_of(topic)
        for reader in self._readers:
            connections = [c for c in reader.connections if c.topic in topics]
            if not connections:
                continue
            count, expected = 0, sum(c.msgcount for c in connections)
            try:
                for connection, log_ns, data in reader.messages(connections):
                    if isinstance(reader, ReaderOfRos1):
                        # The common interfaces differ from those of ROS 2 in the header's `seq`
                        # alone. Other types need the definitions in the bag.
                        _register_type(self._store, connection)
                        data = bytes(self._store.ros1_to_cdr(data, connection.msgtype))
                    count += 1
                    yield Message(connection.topic, log_ns, data)
                if count < expected:  # rosbags ends a chunk without checksum where it is damaged
                    raise SalvageError(f"{expected - count} of {expected} messages are missing")
            except Exception as error:
                # Damaged bytes make the parser fail in many ways: struct, zstd, reader errors.
                yield from islice(self._saved(reader, topics, count, _reason(error)), count, None)

    def _saved(
        self, reader: AnyReader, topics: Collection[str], count: int, reason: str
    ) -> Iterator[Message]:
        """Yield the messages salvaged from a reader that failed after `count` messages."""
        files = _files_of(reader)
        try:
            if not files:
                raise SalvageError(reason)
            saved = [SalvageReader(file) for file in files]
        except Exception as error:  # as above
            if not count:
                raise BagError(
                    f"bag '{self.path}' is damaged: {_reason(error)} ({reason})"
                ) from error
            self._note(
                f"'{reader.path.name}' is damaged ({reason}): the first {count} messages are used"
            )
            return
        for part in saved:
            self._note(part.damage)
        for part in saved:
            chosen = [c for c in part.connections if c.topic in topics]
            for connection, log_ns, data in part.messages(chosen):
                yield Message(connection.topic, log_ns, data)

    def _note(self, damage: str) -> None:
        """Add a line of damage, once: reading again finds it again."""
        if damage and damage not in self.damage:
            self.damage.append(damage)

    def decoder(self, topic: str) -> Callable[[bytes], Any]:
        """Return a function from the bytes of a topic's messages to message objects.

        Types outside ROS 2's common interfaces need a definition in the bag.

        Raises
        ------
        BagError
            If the topic is missing, has several types, or one that is unknown. The function
            raises it for bytes that are no message of the type.
        """
        msgtype = self.type_of(topic)
        for connection in self._connections:
            if connection.topic == topic and connection.msgtype != msgtype:
                raise BagError(
                    f"bag '{self.path}': topic '{topic}' has two types, {msgtype} and "
                    f"{connection.msgtype}"
                )
            if connection.msgtype == msgtype:
                try:
                    _register_type(self._store, connection)
                except Exception as error:
                    raise BagError(
                        f"bag '{self.path}': the definition of {msgtype} of topic '{topic}' cannot "
                        f"be read: {_reason(error)}"
                    ) from error
        if msgtype not in self._store.types:
            raise BagError(
                f"bag '{self.path}': topic '{topic}' is of the unknown type {msgtype}, and the bag "
                "does not define it"
            )

        definition = self._store.get_msgdef(msgtype)
        by_encapsulation = {
            b"\0\0": definition.deserialize_cdr_be,
            b"\0\1": definition.deserialize_cdr_le,
        }

        def decode(data: bytes) -> Any:
            try:
                if (deserialize := by_encapsulation.get(bytes(data[:2]))) is None:
                    raise ValueError("no CDR encapsulation")
                # ROS 2's serializers may leave bytes behind a message. rclpy skips them, too.
                message, _ = deserialize(memoryview(data)[4:], 0, definition.cls, self._store)
                return message
            except Exception as error:
                raise BagError(
                    f"bag '{self.path}': a message on '{topic}' is no {msgtype}: {_reason(error)}"
                ) from error

        return decode


def _opened(path: Path, damage: list[str]) -> list[AnyReader]:
    """Open a bag, or its readable parts; add its defects to `damage`."""
    if not path.exists():
        raise BagError(f"bag '{path}' does not exist")
    if path.name == METADATA_FILE:
        path = path.parent
    files, reason = [path], ""
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in STORAGE_SUFFIXES)
        reason = f"there is no {METADATA_FILE}"
        if (path / METADATA_FILE).exists():
            try:
                return [_open(path)]
            except Exception as error:  # damaged bytes make a parser fail in any way
                reason = f"{METADATA_FILE} cannot be used ({_reason(error, path)})"
        if not files:
            suffixes = " or ".join(STORAGE_SUFFIXES)
            raise BagError(f"bag '{path}' has no {suffixes} file, and {reason}")
    elif not path.is_file():
        raise BagError(f"bag '{path}' is neither a file on a disk nor a folder")
    elif path.suffix not in STORAGE_SUFFIXES:
        raise BagError(
            f"bag '{path}' is no bag: an .mcap file, a rosbag2 folder or a .bag of ROS 1 is needed"
        )
    found: list[str] = []
    readers = [reader for file in files if (reader := _open_file(file, path, found)) is not None]
    if not readers:
        raise BagError("; ".join(found))
    if reason and not found:
        found = [f"{reason}: the files were read without it"]
    damage += found
    # Without metadata the order of the files follows from their start times.
    return sorted(readers, key=lambda reader: reader.start_time)


def _open(storage: Path) -> Reader | ReaderOfRos1:
    """Open a file, or a folder with metadata."""
    of_ros_1 = storage.suffix == SUFFIX_OF_ROS_1 and storage.is_file()
    reader = ReaderOfRos1(storage) if of_ros_1 else Reader(storage)
    reader.open()
    return reader


def _open_file(file: Path, bag: Path, damage: list[str]) -> AnyReader | None:
    """Open one file of a bag, or its readable parts; add its defects to `damage`."""
    try:
        return _open(file)
    except Exception as error:  # as above
        reason = _reason(error, file.parent)
    if file.suffix == ".mcap":
        try:
            saved = SalvageReader(file)
            damage.append(saved.damage or f"'{file.name}': {reason}, yet all of it was read")
            return saved
        except Exception as error:  # as above
            reason = f"'{file.name}': {reason}; {_reason(error)}"
    if file.suffix == ".db3":
        reason = f"{reason} (the tool sqlite3 may save what is there, by '.recover')"
    damage.append(f"bag '{bag}' cannot be read: {reason}")
    return None


def _files_of(reader: AnyReader) -> list[Path]:
    """Return the files of a reader if all are MCAP files; empty otherwise."""
    if not isinstance(reader, Reader):
        return []
    storages = getattr(reader.storage, "storages", [reader.storage])
    paths = [Path(str(storage.path)) for storage in storages]
    return paths if all(path.suffix == ".mcap" for path in paths) else []


def _reason(error: Exception, folder: Path | None = None) -> str:
    """Return the reason of a parser's error in one line, without the path of the folder."""
    if isinstance(error, KeyError):
        return f"unexpected entry {error}"
    line, *_ = str(error).splitlines() or [type(error).__name__]
    return line.rstrip(".").replace(f"{folder}{os.sep}", "")
