# SPDX-License-Identifier: Apache-2.0
"""What a report was made from and with: files with their hashes, versions of the software."""

from __future__ import annotations

import hashlib
import platform
from importlib import metadata
from pathlib import Path

import uav_ident_ros
from uav_ident_ros.bags.reading import STORAGE_SUFFIXES, BagError

PACKAGES = ("numpy", "rosbags", "bokeh")
"""Packages that the numbers or the pictures depend on."""


def bag_files(bag: Path) -> list[tuple[str, int, str]]:
    """Return name, size in bytes and SHA-256 of every file with messages of a bag.

    Raises
    ------
    BagError
        If a file cannot be read.
    """
    files = [bag]
    if bag.is_dir():
        files = sorted(file for file in bag.iterdir() if file.suffix in STORAGE_SUFFIXES)
    return [(file.name, *_size_and_hash(file)) for file in files]


def _size_and_hash(file: Path) -> tuple[int, str]:
    try:
        with file.open("rb") as content:
            digest = hashlib.file_digest(content, "sha256").hexdigest()
        return file.stat().st_size, digest
    except OSError as error:
        raise BagError(f"bag '{file}' cannot be read: {error.strerror}") from None


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of what it computes and draws with."""
    found = {"uav_ident_ros": uav_ident_ros.__version__, "Python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "unknown"
    return found
