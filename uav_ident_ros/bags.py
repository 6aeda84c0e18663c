# SPDX-License-Identifier: Apache-2.0
"""Read bags: MCAP files and rosbag2 folders, messages in log-time order."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

METADATA_FILE = "metadata.yaml"
STORAGE_SUFFIXES = (".mcap", ".db3")
MCAP_MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of every complete MCAP file."""


class BagError(Exception):
    """A bag cannot be read; the message names the bag or topic and what is wrong."""


class Message(NamedTuple):
    """One message of a bag.

    Parameters
    ----------
    topic : str
        Its topic.
    log_ns : int
        When it was recorded, ns.
    data : bytes
        The serialized message (CDR).
    """

    topic: str
    log_ns: int
    data: bytes


class Bag:
    """A bag that is open for reading; a context manager.

    Parameters
    ----------
    path : Path or str
        An MCAP file, or a rosbag2 folder; its metadata file may be missing.

    Attributes
    ----------
    types : dict
        Message type of each topic, by name.
    counts : dict
        Number of messages of each topic.

    Raises
    ------
    BagError
        If there is no bag, or it is damaged.

    Examples
    --------
    >>> with Bag("bags/flight") as bag:                                   # doctest: +SKIP
    ...     decode = bag.decoder("/imu/data")
    ...     for topic, log_ns, data in bag.messages(["/imu/data"]):
    ...         print(log_ns, decode(data).angular_velocity.x)
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._stack = ExitStack()
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._readers: list[Reader] = []
        try:
            for storage in _storages(self.path):
                reader = _open(storage, self.path)
                self._stack.callback(reader.close)
                self._readers.append(reader)
            self.damage: list[str] = []
            self.types = self._types()
            self.counts = self._counts()
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Bag:
        """Return the bag itself: it is open from the start."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the files."""
        self._stack.close()

    def _connections(self) -> list[Connection]:
        return [c for reader in self._readers for c in reader.connections]

    def _types(self) -> dict[str, str]:
        types: dict[str, str] = {}
        for connection in self._connections():
            if types.setdefault(connection.topic, connection.msgtype) != connection.msgtype:
                raise BagError(
                    f"bag '{self.path}': topic '{connection.topic}' has two types, "
                    f"{types[connection.topic]} and {connection.msgtype}"
                )
        return dict(sorted(types.items()))

    def _counts(self) -> dict[str, int]:
        counts = dict.fromkeys(self.types, 0)
        for connection in self._connections():
            counts[connection.topic] += connection.msgcount
        return counts

    @property
    def start_ns(self) -> int:
        """Log time of the first message, ns."""
        return min(reader.start_time for reader in self._readers)

    @property
    def end_ns(self) -> int:
        """Log time of the last message, ns."""
        return max(reader.end_time for reader in self._readers) - 1

    def type_of(self, topic: str) -> str:
        """Return the message type of a topic.

        Raises
        ------
        BagError
            If the bag has no such topic.
        """
        try:
            return self.types[topic]
        except KeyError:
            raise BagError(
                f"bag '{self.path}' has no topic '{topic}'; it has {self.contents()}"
            ) from None

    def with_types(self, types: Collection[str]) -> list[str]:
        """Return the topics of some types that have messages."""
        return [topic for topic, t in self.types.items() if t in types and self.counts[topic]]

    def contents(self) -> str:
        """List the topics with their types in one line."""
        listed = [f"{topic} ({msgtype})" for topic, msgtype in self.types.items()]
        return ", ".join(listed) or "no topics at all"

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics in log-time order.

        Only a chunk of the bag is in memory at a time.

        Raises
        ------
        BagError
            If a topic is missing or the bag turns out to be damaged.
        """
        for topic in topics:
            self.type_of(topic)
        for reader in self._readers:
            connections = [c for c in reader.connections if c.topic in topics]
            if not connections:
                continue
            try:
                for connection, log_ns, data in reader.messages(connections):
                    yield Message(connection.topic, log_ns, data)
            except Exception as error:
                # Damaged bytes make the parser fail in many ways: struct, zstd, reader errors.
                raise BagError(f"bag '{self.path}' is damaged: {_reason(error)}") from error

    def decoder(self, topic: str) -> Callable[[bytes], Any]:
        """Return a function from the bytes of a topic's messages to message objects.

        Types that ROS 2's common interfaces lack are read by the definition in the bag.

        Raises
        ------
        BagError
            If the topic is missing or its type is unknown. The function raises it for bytes
            that are not such a message.
        """
        msgtype = self.type_of(topic)
        if msgtype not in self._store.types:
            self._register(topic, msgtype)
        deserialize = self._store.deserialize_cdr

        def decode(data: bytes) -> Any:
            try:
                return deserialize(data, msgtype)
            except Exception as error:
                raise BagError(
                    f"bag '{self.path}': a message on '{topic}' is no {msgtype}: {_reason(error)}"
                ) from error

        return decode

    def _register(self, topic: str, msgtype: str) -> None:
        """Make the bag's own definition of a type known."""
        parsers = {
            MessageDefinitionFormat.MSG: lambda text: get_types_from_msg(text, msgtype),
            MessageDefinitionFormat.IDL: get_types_from_idl,
        }
        for connection in self._connections():
            parse = parsers.get(connection.msgdef.format)
            if connection.msgtype != msgtype or parse is None:
                continue
            try:
                found = parse(connection.msgdef.data)
                self._store.register({n: d for n, d in found.items() if n not in self._store.types})
            except Exception as error:
                raise BagError(
                    f"bag '{self.path}': the definition of {msgtype} of topic '{topic}' cannot be "
                    f"read: {_reason(error)}"
                ) from error
            return
        raise BagError(
            f"bag '{self.path}': topic '{topic}' is of the unknown type {msgtype}, and the bag "
            "does not define it"
        )


def _storages(path: Path) -> list[Path]:
    """Return what to open: a file, a folder with metadata, or the files of one without."""
    if not path.exists():
        raise BagError(f"bag '{path}' does not exist")
    if path.is_file():
        if path.name == METADATA_FILE:
            return [path.parent]
        if path.suffix not in STORAGE_SUFFIXES:
            raise BagError(f"bag '{path}' is no bag: an .mcap file or a rosbag2 folder is needed")
        return [path]
    if (path / METADATA_FILE).exists():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix == ".mcap")
    if not files:
        raise BagError(f"bag '{path}' has neither {METADATA_FILE} nor an .mcap file")
    if len(files) > 1:
        # Without metadata only the recordings themselves know their order.
        files.sort(key=_start)
    return files


def _start(path: Path) -> int:
    reader = _open(path, path)
    try:
        return int(reader.start_time)
    finally:
        reader.close()


def _open(storage: Path, bag: Path) -> Reader:
    """Open a file, or a folder with metadata."""
    try:
        reader = Reader(storage)
        reader.open()
    except Exception as error:
        # As in Bag.messages: what a parser raises on damaged bytes is not to be foreseen.
        reason = _cut_off(storage) or _reason(error)
        raise BagError(f"bag '{bag}' cannot be read: {reason}") from error
    return reader


def _cut_off(storage: Path) -> str:
    """Say which MCAP file is empty, foreign or incomplete; empty if none is."""
    for file in sorted(storage.glob("*.mcap")) if storage.is_dir() else [storage]:
        if file.suffix != ".mcap" or not file.is_file():
            continue
        with file.open("rb") as content:
            start = content.read(len(MCAP_MAGIC))
            content.seek(max(file.stat().st_size - len(MCAP_MAGIC), 0))
            end = content.read()
        if start != MCAP_MAGIC:
            return f"'{file.name}' is {'no MCAP file' if start else 'empty'}"
        if end != MCAP_MAGIC:
            return f"'{file.name}' is cut off at its end ('mcap recover' saves what is there)"
    return ""


def _reason(error: Exception) -> str:
    """One line on what a parser stumbled over."""
    if isinstance(error, KeyError):
        return f"unexpected entry {error}"
    lines = str(error).splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
