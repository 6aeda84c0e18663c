# SPDX-License-Identifier: Apache-2.0
"""What a bag may cost: how large its compressed parts may become.

The libraries decompress whatever a file holds: 192 kB of zstd become gigabytes. Their functions
for it are replaced, in one place, by ones that stop.
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
"""Bytes of the largest compressed chunk or message, decompressed. Recorders close a chunk at one to
eight million bytes; reading takes a few times as much memory."""

LARGEST_RATIO = 100
"""A file that is compressed as a whole may become so many times as large, or `LARGEST_PART`: Imu
messages shrink to a fifth, those of a sensor that stands still to a fiftieth."""


class TooLargeError(Exception):
    """A compressed part of a bag becomes too large; the message says how large it may be."""

    def __init__(self, what: str, limit: int = LARGEST_PART) -> None:
        super().__init__(f"{what} holds more than {limit / 2**20:.0f} MiB when it is decompressed")


def decompressed(data: bytes, compression: str) -> bytes:
    """Return what a chunk holds; raises `TooLargeError` if that is more than `LARGEST_PART`.

    The compression is ``bz2``, ``lz4``, ``zstd`` or nothing.
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
    """A file compressed as a whole, for reading."""

    def read(self, size: int | None = -1) -> bytes:
        """Read some bytes."""
        data: bytes = super().read(size)
        limit = max(LARGEST_PART, LARGEST_RATIO * os.fstat(self.fileno()).st_size)
        if self.tell() > limit:
            raise TooLargeError("the compressed file", limit)
        return data


def guard_rosbags() -> None:
    """Let rosbags decompress what fits, and nothing else."""
    for name in ("lz4", "zstd"):
        storage_mcap.DECOMPRESSORS[name] = lambda data, _, name=name: decompressed(data, name)
    for name in ("bz2", "lz4"):
        rosbag1.decompressors[name] = partial(decompressed, compression=name)
    reader.zstd = SimpleNamespace(
        open=_BoundedFile, decompress=partial(decompressed, compression="zstd")
    )
