# SPDX-License-Identifier: Apache-2.0
"""What makes two replays the same: the bag's bytes, the settings, the version of the package."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import uav_ident_ros
from uav_ident_ros.bags.reading import STORAGE_SUFFIXES, BagError
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.offline.job import Job


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


def identity_of(job: Job) -> str:
    """Return the hashes of a job's bag and settings, ``BAG:SETTINGS``.

    Raises
    ------
    BagError, ParameterFileError
        If the bag or a parameter file cannot be read.
    """
    values: dict[str, object] = {}
    for file in job.params_files:
        values.update(load_parameters(file, job.node))
    initial = values.get("initial_coefficients_file")
    settings = {
        "version": uav_ident_ros.__version__,
        "values": values,
        "initial": _size_and_hash(Path(str(initial))) if initial else None,
        "node": job.node,
        "topics": dict(job.topics),
        "plot": job.plot,
        "report": job.report,
    }
    return f"{_digest(bag_files(job.bag))}:{_digest(settings)}"


def _digest(content: object) -> str:
    text = json.dumps(content, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()
