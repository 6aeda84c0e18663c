# SPDX-License-Identifier: Apache-2.0
"""Limits on the memory for a bag: sizes of its compressed parts after decompression.

The libraries decompress without a limit: 192 kB of zstd become gigabytes. `guard_rosbags` replaces
their functions by ones with a limit.
"""

import os
from bz2 import BZ2Decompressor
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import reader, storage_mcap

LARGEST_PART = 64 * 2**20
"""Largest size of a chunk or message after decompression, bytes. Recorders close a chunk at one to
eight million bytes; reading takes a few times as much memory."""

LARGEST_COMPRESSION = 100
"""Largest ratio of a file that is compressed as a whole; up to `LARGEST_PART` any ratio is allowed.
Imu messages shrink to a fifth, those of a sensor at rest to a fiftieth."""


class TooLargeError(Exception):
    """A compressed part of a bag is too large; the message gives the limit."""

    def __init__(self, what: str, limit: int = LARGEST_PART) -> None:
        super().__init__(f"{what} holds more than {limit / 2**20:.0f} MiB when it is decompressed")


def decompressed(data: bytes, compression: str) -> bytes:
    """Return the content of a chunk; raises `TooLargeError` beyond `LARGEST_PART`.

    The compression is ``bz2``, ``lz4``, ``zstd`` or empty.
    """
    from lz4.frame import LZ4FrameDecompressor

    if not compression:
        return data
    makers: dict[str, Callable[[], Any]] = {
        "bz2": BZ2Decompressor,
        "lz4": LZ4FrameDecompressor,
        "zstd": storage_mcap.zstd.ZstdDecompressor,
    }
    result: bytes = makers[compression]().decompress(data, max_length=LARGEST_PART + 1)
    if len(result) > LARGEST_PART:
        raise TooLargeError("a chunk")
    return result


class _BoundedFile(reader.zstd.ZstdFile):
    """Reader of a file that is compressed as a whole, with a limit on its size."""

    def read(self, size: int | None = -1) -> bytes:
        """Read up to `size` bytes; raises `TooLargeError` beyond the limit."""
        data: bytes = super().read(size)
        limit = max(LARGEST_PART, LARGEST_COMPRESSION * os.fstat(self.fileno()).st_size)
        if self.tell() > limit:
            raise TooLargeError("the compressed file", limit)
        return data


def guard_rosbags() -> None:
    """Replace the decompression in rosbags by functions with a limit."""
    for name in ("lz4", "zstd"):
        storage_mcap.DECOMPRESSORS[name] = lambda data, _, name=name: decompressed(data, name)
    for name in ("bz2", "lz4"):
        rosbag1.decompressors[name] = partial(decompressed, compression=name)
    reader.zstd = SimpleNamespace(
        open=_BoundedFile, decompress=partial(decompressed, compression="zstd")
    )
