# SPDX-License-Identifier: Apache-2.0
"""Salvage of damaged MCAP files, record by record, with the mcap library.

A killed recorder leaves a file without an index; a bad disk damages single chunks. Every whole
chunk is used, and of a truncated last chunk the messages before the cut: with chunks of 768 kB,
200 Hz of Imu and 50 Hz of actuators these are up to eight seconds. A chunk with a wrong checksum
is left out as a whole: any of its messages may be wrong.
"""

from __future__ import annotations

import heapq
import mmap
import re
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)

from uav_ident_ros.bags.limits import decompressed
from uav_ident_ros.identification.samples import NS

FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
"""Encodings of the definitions in a file."""

RECORD_HEADER, MAGIC_SIZE = 9, 8
"""Bytes of a record's header (kind and length), and before the first record."""

CHUNK = re.compile(
    rb"\x06(?=(.{8})(.{8})(.{8}).{12}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)(.{8}))", re.DOTALL
)
"""Start of a chunk: length, first and last time, size and checksum, compression, length of data."""


class Part(NamedTuple):
    """A part of a file: a chunk, or the records between two of them."""

    begin: int  # begin, end: positions in the file, bytes
    end: int
    times_ns: tuple[int, int] | None = None  # First and last log time of a chunk, ns
    last: bool = False  # Whether the file ends with it


class SalvageError(Exception):
    """Nothing can be salvaged; the message gives the reason."""


class SalvageReader:
    """Reader of a damaged MCAP file, in log-time order, with the interface of rosbags' Reader.

    Raises
    ------
    SalvageError
        If the file has no readable message.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._parts: list[Part] = []  # Those with messages
        # start_time, end_time: Log time of the first message and the time after the last, ns
        self.start_time, self.end_time = 2**63 - 1, 0
        self._lost: list[tuple[int, int]] = []  # First and last log time of unreadable chunks, ns
        with path.open("rb") as file:
            problem = self._scan(file)
        saved = sum(n for channel, n in self._counts.items() if channel in self._channels)
        if not saved:
            nothing = "it is no MCAP file, or nothing is left of it"
            raise SalvageError(
                f"there is no message to be saved: {f'it {problem}' if self._lost else nothing}"
            )
        # Topics of the file
        self.connections = [self._connection(c) for _, c in sorted(self._channels.items())]
        # Extent of the loss, in a line; empty if the file is whole
        self.damage = f"'{path.name}' {problem}; {saved} messages were saved" if problem else ""

    def _scan(self, file: IO[bytes]) -> str:
        """Read the whole file; return its defects, empty if there are none."""
        chunks, torn, cut, indexed = 0, 0, False, 0
        for part in _parts(file):
            before, ended = self._counts.total(), False
            chunks += part.times_ns is not None
            try:
                for record in _records(file, part):
                    self._take(record)
                    ended = ended or isinstance(record, DataEnd)
                    indexed += len(record.records) if isinstance(record, MessageIndex) else 0
            except Exception:  # damaged bytes make the parser fail in many ways
                if part.times_ns is not None:
                    self._lost.append(part.times_ns)
                elif part.last:
                    cut = not ended
                else:
                    torn += 1
            if self._counts.total() > before:
                self._parts.append(part)
        found = []
        if lost := self._lost:
            zero = min(self.start_time, *(first for first, _ in lost))
            begin = (min(first for first, _ in lost) - zero) * NS
            end = (max(last for _, last in lost) - zero) * NS
            found.append(
                f"is damaged: {len(lost)} of {chunks} chunks are left out, "
                f"between {begin:.1f} s and {end:.1f} s after its start"
            )
        found += [f"cannot be read in {torn} places between chunks"] * (torn > 0)
        found += ["is cut off at its end"] * cut
        if not found and self._counts.total() < indexed:  # chunks without checksum
            found.append(f"lacks {indexed - self._counts.total()} messages of its index")
        return " and ".join(found)

    def _take(self, record: McapRecord) -> None:
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
        form = FORMATS.get(schema.encoding) if schema else None
        text = schema.data.decode(errors="replace") if schema and form else ""
        return Connection(
            id=channel.id,
            topic=channel.topic,
            msgtype=schema.name if schema else "unknown",
            msgdef=MessageDefinition(form or MessageDefinitionFormat.NONE, text),
            digest="",
            msgcount=self._counts[channel.id],
            ext=ConnectionExtRosbag2("cdr", []),
            owner=self,
        )

    def close(self) -> None:
        """Do nothing: files are open only during reading."""

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, log time and bytes of the messages of some connections."""
        chosen = {connection.id: connection for connection in connections}
        with self.path.open("rb") as file:
            parts = [_by_time(file, part, chosen) for part in self._parts]
            for log_ns, _, message in heapq.merge(*parts, key=lambda entry: entry[:2]):
                if message is not None:
                    yield chosen[message.channel_id], log_ns, message.data


def _by_time(
    file: IO[bytes], part: Part, chosen: Collection[int]
) -> Iterator[tuple[int, int, Message | None]]:
    """Yield log time, ns, position and message of a part, after a marker of its start."""
    # Until the merge reaches this part, only the marker is in memory.
    yield part.times_ns[0] if part.times_ns else 0, 0, None
    found = []
    with suppress(Exception):  # as when the file was scanned
        for record in _records(file, part):
            if isinstance(record, Message) and record.channel_id in chosen:
                found.append(record)
    for message in sorted(found, key=lambda message: message.log_time):
        yield message.log_time, part.begin, message


def _parts(file: IO[bytes]) -> Iterator[Part]:
    """Yield the chunks, found by their form alone, and the parts between them."""
    at, size = MAGIC_SIZE, file.seek(0, 2)
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for found in CHUNK.finditer(data):
            length, first, last, inner = (int.from_bytes(part, "little") for part in found.groups())
            begin, end = found.start(), found.start() + RECORD_HEADER + length
            # A match before the end of the last chunk is data inside of it.
            if at <= begin and end <= size and found.end(4) + inner == end:
                yield Part(at, begin)
                yield Part(begin, end, (first, last))
                at = end
    yield Part(at, size, last=True)


def _records(file: IO[bytes], part: Part) -> Iterator[McapRecord]:
    """Yield the records of a part, those of chunks too; raises at an unreadable one."""
    at, size = part.begin, part.end - part.begin
    file.seek(at)
    reader = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=size)
    try:
        for record in reader.records if size else ():
            after = file.tell()
            if isinstance(record, Chunk):
                data = decompressed(record.data, record.compression)
                whole = replace(record, data=data, compression="")
                yield from breakup_chunk(whole, validate_crc=True)
            else:
                yield record
            if after >= part.end:
                return
            at = after
    except Exception:
        if part.last:
            yield from _before_the_cut(file, at)
        raise


def _before_the_cut(file: IO[bytes], begin: int) -> Iterator[McapRecord]:
    """Yield the whole records of a truncated chunk."""
    file.seek(begin)
    stream = ReadDataStream(file)
    with suppress(Exception):  # too little is left
        if stream.read1() == Opcode.CHUNK:
            stream.read8()  # its length
            chunk = Chunk.read(stream)
            data = decompressed(chunk.data, chunk.compression)
            yield from _records(BytesIO(data), Part(0, len(data)))
