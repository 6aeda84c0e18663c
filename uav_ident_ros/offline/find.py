# SPDX-License-Identifier: Apache-2.0
"""Which bags are meant: files, rosbag2 folders, and folders with any number of them."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from uav_ident_ros.bags.reading import METADATA_FILE, STORAGE_SUFFIXES, BagError

RESULT_FILE = "summary.json"
RESULT_BAG = "estimates"
"""A folder of this name beside `RESULT_FILE` is a result of an earlier replay, not a flight."""

SPLIT_NUMBER = re.compile(r"_\d+$")
"""How rosbag2 numbers the files of one recording: flight/flight_0.mcap, flight/flight_1.mcap."""


def is_collection(path: Path) -> bool:
    """Whether a path is a folder of bags and not a bag itself.

    A folder without metadata that holds one storage file, or the numbered files of one
    recording, is a bag.
    """
    if not path.is_dir() or (path / METADATA_FILE).exists():
        return False
    return not _is_recording(_storage_files(path)) or bool(_below(path))


def find_bags(path: Path) -> list[Path]:
    """Return the bags in a folder of them, at any depth, in the order of their names.

    Raises
    ------
    BagError
        If there is none.
    """
    found = _found_in(path)
    if not found:
        raise BagError(
            f"folder '{path}' has no bags: neither rosbag2 folders nor "
            f"{' or '.join(STORAGE_SUFFIXES)} files"
        )
    return found


def _found_in(folder: Path) -> list[Path]:
    if not is_collection(folder):
        return [folder]
    return sorted([*_storage_files(folder), *_below(folder)])


def _below(folder: Path) -> list[Path]:
    return [
        bag
        for entry in sorted(folder.iterdir())
        if entry.is_dir() and not entry.name.startswith(".") and not _is_result(entry)
        for bag in (_found_in(entry) if _holds_anything(entry) else [])
    ]


def _holds_anything(folder: Path) -> bool:
    return any(
        path.suffix in STORAGE_SUFFIXES or path.name == METADATA_FILE for path in folder.rglob("*")
    )


def _is_result(folder: Path) -> bool:
    return folder.name == RESULT_BAG and (folder.parent / RESULT_FILE).exists()


def _storage_files(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if p.is_file() and p.suffix in STORAGE_SUFFIXES]


def _is_recording(files: Sequence[Path]) -> bool:
    """Whether storage files are those of one recording."""
    if len(files) == 1:
        return True
    stems = {SPLIT_NUMBER.sub("", file.stem) for file in files}
    return len(stems) == 1 and all(SPLIT_NUMBER.search(file.stem) for file in files)


def names_of(bags: Sequence[Path]) -> list[str]:
    """Return a name for each bag that no other has: its own, with its folder's where needed."""
    resolved = [bag.resolve() for bag in bags]
    names = [path.stem for path in resolved]
    taken = Counter(names)
    names = [
        f"{path.parent.name}_{name}" if taken[name] > 1 else name
        for path, name in zip(resolved, names, strict=True)
    ]
    seen: Counter[str] = Counter()
    unique = []
    for name in names:
        seen[name] += 1
        unique.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return unique
