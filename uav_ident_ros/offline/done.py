# SPDX-License-Identifier: Apache-2.0
"""Which flights were replayed already: each folder of results says of what they are.

Two replays are the same if the bag's bytes, the settings and the package's version are. The file is
written last, so that a replay that was cut off has none, and one that has is not done again.
"""

import hashlib
import json
import os
from pathlib import Path

import uav_ident_ros
from uav_ident_ros.bags.reading import STORAGE_SUFFIXES, BagError
from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.offline.job import Job, Outcome, parameters_of
from uav_ident_ros.offline.status import NO_RESULT

DONE_FILE = "replayed.json"


def recalled(job: Job, identity: str) -> Outcome | None:
    """Return the outcome that a job had before; None if there is none of this identity."""
    try:
        entry = json.loads((job.folder / DONE_FILE).read_text(encoding="utf-8"))
        if entry["identity"] != identity:
            return None
        status, warnings, summary = entry["status"], tuple(entry["warnings"]), {}
        if status != NO_RESULT:
            summary = json.loads((job.folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Outcome(job, status, warnings, summary=summary, identity=identity, kept=True)


def forget(job: Job) -> None:
    """Remove what says that a job was done: its results are about to be written anew."""
    try:
        (job.folder / DONE_FILE).unlink(missing_ok=True)
    except OSError as error:
        raise BagWriteError(f"cannot write to '{job.folder}': {error.strerror}") from None


def remember(outcome: Outcome) -> None:
    """Write down an outcome, once everything else is written."""
    entry = {
        "identity": outcome.identity,
        "status": outcome.status,
        "warnings": list(outcome.warnings),
    }
    folder = outcome.job.folder
    part = folder / f".{DONE_FILE}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part.write_text(json.dumps(entry) + "\n", encoding="utf-8")
        os.replace(part, folder / DONE_FILE)
    except OSError as error:
        raise BagWriteError(f"cannot write to '{folder}': {error.strerror}") from None


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
    values = parameters_of(job)
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
