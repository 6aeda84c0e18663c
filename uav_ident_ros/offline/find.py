# SPDX-License-Identifier: Apache-2.0
"""Search for bags: files, rosbag2 folders, and folders with any number of them."""

import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from uav_ident_ros.bags.reading import METADATA_FILE, STORAGE_SUFFIXES, BagError

RESULT_FILE = "summary.json"
RESULT_BAG = "estimates"
"""A folder of this name beside `RESULT_FILE` is a result of an earlier replay, not a flight."""

SPLIT_NUMBER = re.compile(r"_\d+$")
"""Number of a file of one rosbag2 recording: flight/flight_0.mcap, flight/flight_1.mcap."""


def find_bags(path: Path) -> list[Path]:
    """Return the bags of a path: itself, or those in a folder at any depth, in the order of names.

    A folder without metadata that holds one storage file, or the numbered files of one
    recording, is a bag.
    """
    if not path.is_dir() or (path / METADATA_FILE).exists():
        return [path]
    files, below = storage_files(path), _below(path)
    recordings = {SPLIT_NUMBER.sub("", file.stem) for file in files}
    numbered = all(SPLIT_NUMBER.search(file.stem) for file in files)
    is_recording = len(files) == 1 or (len(recordings) == 1 and numbered)
    return [path] if is_recording and not below else sorted([*files, *below])


def storage_files(folder: Path) -> list[Path]:
    """Return the storage files of a folder."""
    return sorted(p for p in folder.iterdir() if p.is_file() and p.suffix in STORAGE_SUFFIXES)


def _below(folder: Path) -> list[Path]:
    """Return the bags in the subfolders of a folder, without hidden folders and results."""
    folders = [
        entry
        for entry in folder.iterdir()
        if entry.is_dir()
        and not entry.name.startswith(".")
        and not (entry.name == RESULT_BAG and (folder / RESULT_FILE).exists())
    ]
    return [bag for entry in folders for bag in find_bags(entry)]


def names_of(bags: Sequence[Path]) -> list[str]:
    """Return a unique name for each bag: its own, with that of its folder if needed."""
    paths = [bag.resolve() for bag in bags]
    taken = Counter(path.stem for path in paths)
    seen: Counter[str] = Counter()
    names = []
    for path in paths:
        name = f"{path.parent.name}_{path.stem}" if taken[path.stem] > 1 else path.stem
        seen[name] += 1
        names.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return names


def bag_files(bag: Path) -> list[tuple[str, int, str]]:
    """Return name, size and SHA-256 of every storage file of a bag; raises `BagError`."""
    return [name_size_hash(file) for file in (storage_files(bag) if bag.is_dir() else [bag])]


def name_size_hash(file: Path) -> tuple[str, int, str]:
    """Return name, size in bytes and SHA-256 of a file; raises `BagError`."""
    if file.exists() and not file.is_file():  # a pipe would block for ever
        raise BagError(f"bag '{file}' is no file on a disk")
    try:
        with file.open("rb") as content:
            digest = hashlib.file_digest(content, "sha256").hexdigest()
        return file.name, file.stat().st_size, digest
    except OSError as error:
        raise BagError(f"bag '{file}' cannot be read: {error.strerror}") from None
