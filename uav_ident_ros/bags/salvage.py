# SPDX-License-Identifier: Apache-2.0
"""What a damaged MCAP file still holds, read record by record with the mcap library.

A recorder that was killed leaves a file without an index; a bad disk spoils single chunks. Every
chunk that is whole is used, of a last one that is cut off the messages before the cut. A chunk that
does not check out is left out as a whole: nobody knows which of its messages are right.
"""

from __future__ import annotations

import heapq
import mmap
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)

from uav_ident_ros.bags.limits import decompressed

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, McapRecord, Message, Schema

NS = 1e-9
ENCODING = "cdr"

FORMATS: Mapping[str, MessageDefinitionFormat] = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
}
"""Encodings of the definitions in a file."""

RECORD_HEADER = 9
"""Bytes of a record before what it holds: its kind and length."""

CHUNK = re.compile(
    rb"\x06(?=(.{8}).{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)(.{8}))", re.DOTALL
)
"""Begin of a chunk: length, times, size and checksum, compression, length of the data."""

MAGIC_SIZE = 8
"""Bytes before the first record."""


class SalvageError(Exception):
    """Nothing can be saved; the message says why."""


@dataclass
class _Contents:
    """What a pass over a file has found.

    Attributes
    ----------
    schemas, channels : dict
        Definitions and topics, by the file's own numbers.
    counts : Counter
        Messages of each channel.
    chunks : list of (int, int, bool)
        Position, time of the first message (ns), and whether it is whole, of each usable chunk.
    loose : bool
        Whether there are messages outside of chunks.
    lost : list of (int, int)
        First and last time of the chunks that are left out, ns.
    indexed : bool
        Whether there is an index.
    ended : bool
        Whether the end of the messages was reached; the index follows.
    cut : bool
        Whether the file ends before.
    torn : int
        Places between chunks that cannot be read.
    start_ns, end_ns : int
        First and last log time, ns.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    chunks: list[tuple[int, int, bool]] = field(default_factory=list)
    loose: bool = False
    lost: list[tuple[int, int]] = field(default_factory=list)
    indexed: bool = False
    ended: bool = False
    cut: bool = False
    torn: int = 0
    start_ns: int = 2**63 - 1
    end_ns: int = 0

    def add(self, record: McapRecord) -> None:
        """Take a definition, a topic or a message."""
        from mcap.records import Channel, Message, Schema

        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Message):
            self.counts[record.channel_id] += 1
            self.start_ns = min(self.start_ns, record.log_time)
            self.end_ns = max(self.end_ns, record.log_time)


class SalvageReader:
    """Reads what is left of a damaged MCAP file, in log-time order; in use like rosbags' Reader.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    connections : list of Connection
        Its topics.
    damage : str
        What is lost, in a line; empty if the file is whole.
    start_time, end_time : int
        Log time of the first message and the time after the last, ns.

    Raises
    ------
    SalvageError
        If there is no message to be saved, or the mcap library is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            import mcap.stream_reader  # noqa: F401
        except ImportError:
            raise SalvageError(
                "install the Python package 'mcap' to save what is there (pip install mcap)"
            ) from None
        with path.open("rb") as file:
            self._contents = contents = _scan(file)
        saved = sum(n for channel, n in contents.counts.items() if channel in contents.channels)
        if not saved:
            raise SalvageError("there is no message to be saved")
        self.start_time, self.end_time = contents.start_ns, contents.end_ns + 1
        self.connections = [self._connection(c) for _, c in sorted(contents.channels.items())]
        words = _damage(contents)
        self.damage = f"'{path.name}' {words}; {saved} messages were saved" if words else ""

    def _connection(self, channel: Channel) -> Connection:
        schema = self._contents.schemas.get(channel.schema_id)
        form = MessageDefinitionFormat.NONE
        if schema is not None:
            form = FORMATS.get(schema.encoding, form)
        text = schema.data.decode(errors="replace") if schema is not None else ""
        return Connection(
            id=channel.id,
            topic=channel.topic,
            msgtype=schema.name if schema is not None else "unknown",
            msgdef=MessageDefinition(form, text if form != MessageDefinitionFormat.NONE else ""),
            digest="",
            msgcount=self._contents.counts[channel.id],
            ext=ConnectionExtRosbag2(ENCODING, []),
            owner=self,
        )

    def close(self) -> None:
        """Do nothing: files are open only while they are read."""

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, log time and bytes of the messages of some connections."""
        chosen = {connection.id: connection for connection in connections}
        with self.path.open("rb") as file:
            parts = [self._of_chunk(file, chosen, *chunk) for chunk in self._contents.chunks]
            if self._contents.loose:
                parts.append(_loose(file, chosen))
            for log_ns, _, message in heapq.merge(*parts, key=lambda part: part[:2]):
                if message is not None:
                    yield chosen[message.channel_id], log_ns, message.data

    def _of_chunk(
        self, file: IO[bytes], chosen: Collection[int], position: int, start_ns: int, whole: bool
    ) -> Iterator[tuple[int, int, Message | None]]:
        """Yield the chunk's messages by their time, after a sign that it begins."""
        # Until the merge comes to this chunk the sign alone is in memory.
        yield start_ns, 0, None
        found = [m for m in _unpacked(_chunk_at(file, position), whole=whole) if _is_of(m, chosen)]
        found.sort(key=lambda message: message.log_time)
        for message in found:
            yield message.log_time, position, message


def _is_of(record: Any, chosen: Collection[int]) -> bool:
    from mcap.records import Message

    return isinstance(record, Message) and record.channel_id in chosen


def _loose(file: IO[bytes], chosen: Collection[int]) -> Iterator[tuple[int, int, Message | None]]:
    """Yield the messages that are in no chunk, by their time."""
    records: list[Any] = [record for _, record in _records(file, []) if _is_of(record, chosen)]
    records.sort(key=lambda message: message.log_time)
    for message in records:
        yield message.log_time, 1, message


def _scan(file: IO[bytes]) -> _Contents:
    """Read a whole file and say what is in it."""
    from mcap.records import Chunk, DataEnd, Message

    contents = _Contents()
    index = _index(file, contents)
    places = _chunk_places(file)
    for position, record in _records(file, places):
        if isinstance(record, Chunk):
            _take_chunk(contents, position, record, index)
        elif record is None:
            _take_rest(contents, file, position, index, places)
        else:
            contents.ended = contents.ended or isinstance(record, DataEnd)
            contents.loose = contents.loose or isinstance(record, Message)
            contents.add(record)
    return contents


def _index(file: IO[bytes], contents: _Contents) -> dict[int, tuple[int, int]]:
    """Return position and times of the chunks, if the index at the end of the file is whole."""
    from mcap.reader import make_reader

    try:
        summary = make_reader(file).get_summary()
    except Exception:  # damaged bytes make the parser fail in many ways
        summary = None
    if summary is None:
        return {}
    contents.indexed = True
    contents.schemas.update(summary.schemas)
    contents.channels.update(summary.channels)
    return {
        c.chunk_start_offset: (c.message_start_time, c.message_end_time)
        for c in summary.chunk_indexes
    }


def _records(
    file: IO[bytes], chunk_positions: Sequence[int]
) -> Iterator[tuple[int, McapRecord | None]]:
    """Yield position and content of every record that can be read; None for one that cannot.

    Behind a bad record reading goes on at the next of the known positions of chunks.
    """
    from mcap.stream_reader import StreamReader

    size = file.seek(0, 2)
    position, skip_magic = 0, False
    while True:
        file.seek(position)
        reader = StreamReader(file, skip_magic=skip_magic, emit_chunks=True, record_size_limit=size)
        position = position if skip_magic else MAGIC_SIZE
        try:
            for record in reader.records:
                yield position, record
                position = file.tell()
            return
        except Exception:  # as above
            yield position, None
        following = bisect_right(chunk_positions, position)
        if following == len(chunk_positions):
            return
        position, skip_magic = chunk_positions[following], True


def _chunk_places(file: IO[bytes]) -> list[int]:
    """Find every place where a chunk begins, in rising order: by its form, whatever an index says."""
    size = file.seek(0, 2)
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        result = []
        for found in CHUNK.finditer(data):
            length, inner = (int.from_bytes(found[i], "little") for i in (1, 2))
            begin = found.end(2) - found.start() - RECORD_HEADER
            fits = found.start() + RECORD_HEADER + length <= size
            if fits and begin + inner == length:
                result.append(found.start())
        return result


def _take_chunk(
    contents: _Contents, position: int, chunk: Chunk, index: Mapping[int, tuple[int, int]]
) -> None:
    try:
        records = _unpacked(chunk, whole=True)
    except Exception:  # as above
        times = (chunk.message_start_time, chunk.message_end_time)
        contents.lost.append(index.get(position, times))
        return
    for record in records:
        contents.add(record)
    contents.chunks.append((position, chunk.message_start_time, True))


def _take_rest(
    contents: _Contents,
    file: IO[bytes],
    position: int,
    index: Mapping[int, tuple[int, int]],
    places: Sequence[int],
) -> None:
    """Take what there is of a record that cannot be read."""
    if position in index:
        contents.lost.append(index[position])
        return
    if contents.ended:
        return
    if places and places[-1] > position:
        contents.torn += 1
        return
    contents.cut = True
    try:
        chunk = _chunk_at(file, position)
        records = _unpacked(chunk, whole=False)
    except Exception:  # as above: it is no chunk, or nothing of it is left
        return
    for record in records:
        contents.add(record)
    contents.chunks.append((position, chunk.message_start_time, False))


def _chunk_at(file: IO[bytes], position: int) -> Chunk:
    """Read the chunk at a position; its data may be cut off by the end of the file."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Chunk

    file.seek(position)
    stream = ReadDataStream(file)
    if stream.read1() != Opcode.CHUNK:
        raise SalvageError("no chunk")
    stream.read8()  # its length
    return Chunk.read(stream)


def _unpacked(chunk: Chunk, *, whole: bool) -> list[McapRecord]:
    """Return the records of a chunk; of one that is cut off, those before the cut."""
    from mcap.stream_reader import StreamReader, breakup_chunk

    data = decompressed(chunk.data, chunk.compression)
    if whole:
        return list(breakup_chunk(replace(chunk, data=data, compression=""), validate_crc=True))
    found = []
    try:
        for record in StreamReader(
            BytesIO(data), skip_magic=True, record_size_limit=len(data)
        ).records:
            found.append(record)
    except Exception:  # the cut
        pass
    return found


def _damage(contents: _Contents) -> str:
    """Say what is wrong with a file."""
    found = []
    if contents.lost:
        begin = min(first for first, _ in contents.lost)
        end = max(last for _, last in contents.lost)
        zero = min(contents.start_ns, begin)
        chunks = len(contents.lost) + len(contents.chunks)
        found.append(
            f"is damaged: {len(contents.lost)} of {chunks} chunks are left out, between "
            f"{(begin - zero) * NS:.1f} s and {(end - zero) * NS:.1f} s after its start"
        )
    if contents.torn:
        found.append(f"cannot be read in {contents.torn} places between chunks")
    if contents.cut:
        found.append("is cut off at its end")
    if not found and not contents.indexed:
        found.append("has no usable index")
    return " and ".join(found)
