# SPDX-License-Identifier: Apache-2.0
"""What a damaged MCAP file still holds, read record by record with the mcap library.

A recorder that was killed leaves a file without an index; a bad disk spoils single chunks. Every
chunk that is whole is used, of a last one that is cut off the messages before the cut: at the usual
768 kB, 200 Hz of Imu and 50 Hz of actuators, that is up to eight seconds. A chunk that does not
check out is left out as a whole: nobody knows which of its messages are right.
"""

from __future__ import annotations

import heapq
import mmap
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
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
    from mcap.records import Channel, Chunk, McapRecord, Schema

NS = 1e-9

FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
"""Encodings of the definitions in a file."""

RECORD_HEADER, MAGIC_SIZE = 9, 8
"""Bytes of a record before what it holds, its kind and length; and before the first record."""

CHUNK = re.compile(
    rb"\x06(?=(.{8}).{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)(.{8}))", re.DOTALL
)
"""Begin of a chunk: length, times, size and checksum, compression, length of the data."""

Timed = tuple[int, int, Any]
"""Log time, ns, position of the chunk, and the message; None for a sign that the chunk begins."""


class SalvageError(Exception):
    """Nothing can be saved; the message says why."""


class SalvageReader:
    """Reads what is left of a damaged MCAP file, in log-time order; in use like rosbags' Reader.

    Raises
    ------
    SalvageError
        If there is no message to be saved, or the mcap library is not installed.
    """

    def __init__(
        self,
        path: Path,  # The file
    ) -> None:
        self.path = path
        try:
            import mcap.stream_reader  # noqa: F401
        except ImportError:
            raise SalvageError(
                "install the Python package 'mcap' to save what is there (pip install mcap)"
            ) from None
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[tuple[int, int, bool]] = []  # position, first time, ns, whether whole
        self._loose = False  # whether there are messages outside of chunks
        # start_time, end_time: Log time of the first message and the time after the last, ns
        self.start_time, self.end_time = 2**63 - 1, 0
        with path.open("rb") as file:
            words = self._scan(file)
        saved = sum(n for channel, n in self._counts.items() if channel in self._channels)
        if not saved:
            raise SalvageError("there is no message to be saved")
        # Its topics
        self.connections = [self._connection(c) for _, c in sorted(self._channels.items())]
        # What is lost, in a line; empty if the file is whole
        self.damage = f"'{path.name}' {words}; {saved} messages were saved" if words else ""

    def _scan(self, file: IO[bytes]) -> str:
        """Read the whole file; return what is wrong with it."""
        from mcap.records import Chunk, DataEnd, Message

        lost: list[Chunk] = []
        torn, cut, ended = 0, False, False
        places = _chunk_places(file)
        for position, record in _records(file, places):
            if isinstance(record, Chunk):
                if not self._take_chunk(record, position, whole=True):
                    lost.append(record)
            elif record is not None:
                ended = ended or isinstance(record, DataEnd)
                self._loose = self._loose or isinstance(record, Message)
                self._take([record])
            elif places and places[-1] > position:
                torn += 1
            elif not ended:
                cut = True
                self._take_chunk(_chunk_at(file, position), position, whole=False)
        found = []
        if lost:
            begin, end = (f(getattr(c, f"message_{n}_time") for c in lost)
                          for f, n in ((min, "start"), (max, "end")))  # fmt: skip
            zero = min(self.start_time, begin)
            found.append(
                f"is damaged: {len(lost)} of {len(lost) + len(self._chunks)} chunks are left out, "
                f"between {(begin - zero) * NS:.1f} s and {(end - zero) * NS:.1f} s after its start"
            )
        found += [f"cannot be read in {torn} places between chunks"] * (torn > 0)
        found += ["is cut off at its end"] * cut
        return " and ".join(found)

    def _take_chunk(self, chunk: Chunk | None, position: int, *, whole: bool) -> bool:
        """Take what a chunk holds; return whether anything could be read."""
        try:
            self._take(_unpacked(chunk, whole=whole) if chunk is not None else [])
        except Exception:  # damaged bytes make the parser fail in many ways
            return False
        if chunk is not None:
            self._chunks.append((position, chunk.message_start_time, whole))
        return True

    def _take(self, records: Iterable[McapRecord]) -> None:
        from mcap.records import Channel, Message, Schema

        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Message):
                self._counts[record.channel_id] += 1
                self.start_time = min(self.start_time, record.log_time)
                self.end_time = max(self.end_time, record.log_time + 1)

    def _connection(self, channel: Channel) -> Connection:
        schema = self._schemas.get(channel.schema_id)
        name, form, text = "unknown", MessageDefinitionFormat.NONE, ""
        if schema is not None:
            name, form = schema.name, FORMATS.get(schema.encoding, form)
            text = schema.data.decode(errors="replace") if schema.encoding in FORMATS else ""
        return Connection(
            id=channel.id,
            topic=channel.topic,
            msgtype=name,
            msgdef=MessageDefinition(form, text),
            digest="",
            msgcount=self._counts[channel.id],
            ext=ConnectionExtRosbag2("cdr", []),
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
            parts = [_of_chunk(file, chosen, *chunk) for chunk in self._chunks]
            if self._loose:
                parts.append(_by_time(chosen, (r for _, r in _records(file, [])), 1))
            for log_ns, _, message in heapq.merge(*parts, key=lambda part: part[:2]):
                if message is not None:
                    yield chosen[message.channel_id], log_ns, message.data


def _of_chunk(
    file: IO[bytes], chosen: Collection[int], position: int, start_ns: int, whole: bool
) -> Iterator[Timed]:
    """Yield a chunk's messages by their time, after a sign that it begins."""
    # Until the merge comes to this chunk the sign alone is in memory.
    yield start_ns, 0, None
    chunk = _chunk_at(file, position)
    assert chunk is not None  # as when the file was scanned
    yield from _by_time(chosen, _unpacked(chunk, whole=whole), position)


def _by_time(chosen: Collection[int], records: Iterable[Any], place: int) -> Iterator[Timed]:
    from mcap.records import Message

    found = [r for r in records if isinstance(r, Message) and r.channel_id in chosen]
    for message in sorted(found, key=lambda message: message.log_time):
        yield message.log_time, place, message


def _records(file: IO[bytes], places: list[int]) -> Iterator[tuple[int, McapRecord | None]]:
    """Yield position and content of every record that can be read; None for one that cannot.

    Behind a bad record reading goes on at the next of the known places of chunks.
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
        following = bisect_right(places, position)
        if following == len(places):
            return
        position, skip_magic = places[following], True


def _chunk_places(file: IO[bytes]) -> list[int]:
    """Find every place where a chunk begins, in rising order: by its form alone."""
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


def _chunk_at(file: IO[bytes], position: int) -> Chunk | None:
    """Read the chunk at a position, whose data may be cut off; None if there is none."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Chunk

    file.seek(position)
    stream = ReadDataStream(file)
    try:
        if stream.read1() != Opcode.CHUNK:
            return None
        stream.read8()  # its length
        return Chunk.read(stream)
    except Exception:  # as above: too little is left
        return None


def _unpacked(chunk: Chunk, *, whole: bool) -> list[McapRecord]:
    """Return the records of a chunk; of one that is cut off, those before the cut."""
    from mcap.stream_reader import StreamReader, breakup_chunk

    data = decompressed(chunk.data, chunk.compression)
    if whole:
        return list(breakup_chunk(replace(chunk, data=data, compression=""), validate_crc=True))
    found = []
    reader = StreamReader(BytesIO(data), skip_magic=True, record_size_limit=len(data))
    try:
        for record in reader.records:
            found.append(record)
    except Exception:  # the cut
        pass
    return found
