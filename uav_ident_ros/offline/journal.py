# SPDX-License-Identifier: Apache-2.0
"""Which flights were replayed already: a line for each, written as soon as it is done.

Two replays are the same if the bag's bytes, the settings and the package's version are.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import uav_ident_ros
from uav_ident_ros.bags.reading import STORAGE_SUFFIXES, BagError
from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.offline.job import Job, Outcome
from uav_ident_ros.offline.status import NO_RESULT

JOURNAL_FILE = "replayed.jsonl"


class Journal:
    """Outcomes of earlier runs in a folder, and of this one.

    Raises
    ------
    BagWriteError
        If it cannot be read or written.
    """

    def __init__(
        self,
        folder: Path,  # Folder of the results; made if it is not there
        *,
        again: bool = False,  # Whether to forget what was done before
    ) -> None:
        self._path = folder / JOURNAL_FILE
        self._entries: dict[str, dict[str, Any]] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self._path.exists() and not again:
                self._read()
            # written anew: without the last line of a run that was killed, and without old ones
            lines = [json.dumps(entry) + "\n" for entry in self._entries.values()]
            self._path.write_text("".join(lines), encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise BagWriteError(f"cannot use '{self._path}': {error}") from None

    def _read(self) -> None:
        for line in self._path.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
                self._entries[entry["name"]] = {key: entry[key] for key in _KEYS}
            except (ValueError, KeyError, TypeError):
                continue  # cut off in the middle: that flight is done again

    def informed(self, job: Job) -> Job:
        """Return the job with the identity of its result, if that is still there."""
        entry = self._entries.get(job.name)
        if entry is None:
            return job
        there = entry["status"] == NO_RESULT or (job.folder / "summary.json").exists()
        return replace(job, known=entry["identity"] if there else "")

    def take(self, outcome: Outcome) -> None:
        """Write down an outcome; one without identity is done again next time."""
        if outcome.kept or not outcome.identity:
            return
        entry = {
            "name": outcome.job.name,
            "identity": outcome.identity,
            "status": outcome.status,
            "warnings": list(outcome.warnings),
            "summary": dict(outcome.summary),
        }
        self._entries[outcome.job.name] = entry
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def recalled(self, outcome: Outcome) -> Outcome:
        """Return an outcome, from an earlier run if it was kept."""
        if not outcome.kept:
            return outcome
        entry = self._entries[outcome.job.name]
        return replace(
            outcome,
            status=entry["status"],
            warnings=tuple(entry["warnings"]),
            summary=entry["summary"],
        )


_KEYS = ("name", "identity", "status", "warnings", "summary")


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
