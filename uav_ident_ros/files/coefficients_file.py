# SPDX-License-Identifier: Apache-2.0
"""Coefficients on disk: result of a replay, initial coefficients, state between flights.

One format serves ``coefficients.yaml``, ``initial_coefficients_file`` and the state file:

    format: uav_ident_ros/coefficients
    version: 1
    structure: baseline
    stamp: 1700000000.250000000      # message time, s; 0.0 if unknown
    saved: 2023-11-14T22:13:25Z      # computer's time; this and the next three are notes, which
    usable: true                     # are optional outside of a state file
    delay: 0.05                      # of the actuators, estimated in flight, s
    learned_with: {actuators.scale: "[]", ...}
    coefficients:                    # SI units, body axes forward-right-down
      pdot/pq: {value: 0.0125, sigma: 0.003}
      ...

Numbers are written with all bits. Loading checks every entry.
"""

import glob
import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from yaml.representer import SafeRepresenter

from uav_ident_ros.files.strict_yaml import (
    UNUSABLE,
    EntryError,
    StrictLoader,
    mapping,
    nanoseconds,
    problem,
)
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.settings import MAX_DELAY, Settings
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.messages.types import NS_PER_S

FORMAT = "uav_ident_ros/coefficients"
VERSION = "1"

LARGEST_FILE = 1_000_000
"""Largest size of a coefficients file, bytes: a typical one has a few thousand."""

BEYOND_INT64_NS = 2**63
"""First stamp out of range, ns: stamps are signed integers of 64 bits."""

_TOP_KEYS = ("format", "version", "structure", "stamp", "coefficients")
_NOTE_KEYS = ("saved", "usable", "delay", "servo_lag", "learned_with")
_ENTRY_KEYS = ("value", "sigma")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_INFINITY = frozenset((".inf", ".Inf", ".INF", "+.inf", "inf"))


class CoefficientsFileError(Exception):
    """A coefficients file cannot be used; the message names it and the problem."""


@dataclass(frozen=True)
class Notes:
    """Optional entries of a file beside the coefficients."""

    # Time of writing by the computer's clock, with time zone
    saved: datetime | None = None
    usable: bool | None = None  # Verdict on the coefficients
    delay: float | None = None  # Transport delay of the actuators, estimated in flight, s
    # Settings that define the meaning of the coefficients, with values as JSON
    learned_with: Mapping[str, str] = field(default_factory=dict)
    servo_lag: float | None = None  # Servo lag, estimated in flight, s


def save_coefficients(
    coefficients: CoefficientSet, path: Path | str, notes: Notes | None = None
) -> None:
    """Write a coefficients file, whole or not at all; one that exists is replaced.

    Raises
    ------
    CoefficientsFileError
        If a value is not finite or the file cannot be written.
    """
    # A link is followed: the file that it points to is replaced, not the link.
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        _check_regular(target)
        text = "".join(f"{line}\n" for line in _lines(coefficients, notes or Notes()))
        try:
            with temporary.open("w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
        _sync_folder(target.parent)
    except (OSError, EntryError) as error:
        raise CoefficientsFileError(f"cannot write '{path}': {problem(error)}") from None


def remove_leftovers(path: Path | str) -> None:
    """Remove the temporary files of `path` that killed processes have left."""
    target = Path(os.path.realpath(path))
    for left in target.parent.glob(f".{glob.escape(target.name)}.*.tmp"):
        writer = left.name.removesuffix(".tmp").rpartition(".")[2]
        if writer.isdecimal() and not Path("/proc", writer).exists():
            left.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Flush `folder` to disk: a rename in it then survives a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _lines(coefficients: CoefficientSet, notes: Notes) -> Iterator[str]:
    """Yield the lines of the file."""
    structure = STRUCTURES[coefficients.structure]
    seconds, nanoseconds = divmod(coefficients.t_ns, NS_PER_S)
    yield "# Identified coefficients: SI units, aircraft body axes forward-right-down."
    yield f"format: {FORMAT}"
    yield f"version: {VERSION}"
    yield f"structure: {structure.name}"
    yield f"stamp: {seconds}.{nanoseconds:09d}"
    if notes.saved is not None:
        utc = notes.saved.astimezone(UTC).replace(tzinfo=None)
        yield f"saved: {utc.isoformat()}Z"
    if notes.usable is not None:
        yield f"usable: {json.dumps(notes.usable)}"
    if notes.delay is not None:
        yield f"delay: {_digits(notes.delay)}"
    if notes.servo_lag is not None:
        yield f"servo_lag: {_digits(notes.servo_lag)}"
    if notes.learned_with:
        yield "learned_with:"
        # JSON strings are YAML strings too.
        yield from (f"  {name}: {json.dumps(text)}" for name, text in notes.learned_with.items())
    yield "coefficients:"
    for name, index in structure.places.items():
        value, sigma = float(coefficients.values[index]), float(coefficients.sigma[index])
        if not math.isfinite(value):
            raise EntryError(f"coefficient {name} is {value}")
        sigma = sigma if sigma >= 0.0 else math.inf  # NaN too
        yield f"  {name}: {{value: {_digits(value)}, sigma: {_digits(sigma)}}}"


def _digits(value: float) -> str:
    """Return the shortest text of `value` without loss, a number for every YAML reader."""
    return str(SafeRepresenter().represent_float(value).value)


def load_coefficients(path: Path | str, structure: str | None = None) -> CoefficientSet:
    """Read and check a coefficients file; it must be for `structure`, if given.

    Raises
    ------
    CoefficientsFileError
        If it cannot be read, is damaged or is for another structure.
    """
    return load_with_notes(path, structure)[0]


def initial_coefficients(settings: Settings) -> CoefficientSet | None:
    """Read the initial coefficients, by `load_coefficients`; None if the settings name no file."""
    file = settings.initial_coefficients_file
    return load_coefficients(file, settings.structure) if file else None


def load_with_notes(path: Path | str, structure: str | None = None) -> tuple[CoefficientSet, Notes]:
    """Read a coefficients file and its notes; see `load_coefficients`."""
    if not str(path):
        raise CoefficientsFileError(
            "no coefficients file is named: give the path of a coefficients.yaml, as of replay"
        )
    try:
        _check_regular(Path(path))
        if (size := Path(path).stat().st_size) > LARGEST_FILE:
            raise EntryError(f"it has {size} bytes, more than any such file")
        content = yaml.load(Path(path).read_text(encoding="utf-8"), StrictLoader)
        return _coefficients(content, structure), _notes(content)
    except UNUSABLE as error:
        reason = problem(error)
        if isinstance(error, FileNotFoundError) and not Path(path).is_absolute():
            reason += f" in '{Path.cwd()}': a relative path counts from where the program starts"
        raise CoefficientsFileError(f"coefficients file '{path}': {reason}") from None


def _check_regular(path: Path) -> None:
    """Raise an error for what is no file: a pipe would block, /dev/null must not be replaced."""
    if path.exists() and not path.is_file():
        raise EntryError("it is not a file but a folder, a pipe or the like")


def _coefficients(content: Any, wanted: str | None) -> CoefficientSet:
    """Return the coefficients from the checked mandatory entries."""
    top = mapping(content, "the file", _TOP_KEYS, _NOTE_KEYS)
    name = top["structure"]
    if top["format"] != FORMAT:
        raise EntryError(f"the format is '{top['format']}', not '{FORMAT}'")
    if top["version"] != VERSION:
        raise EntryError(f"version {top['version']} is not known, only {VERSION} is")
    if name not in [*STRUCTURES]:
        raise EntryError(f"structure '{name}' is unknown, known are {', '.join(STRUCTURES)}")
    if wanted is not None and name != wanted:
        raise EntryError(f"it is for structure '{name}', but 'structure' is '{wanted}'")
    structure = STRUCTURES[name]
    entries = mapping(top["coefficients"], "coefficients", structure.names)
    values, sigma = np.zeros(structure.mask.shape), np.zeros(structure.mask.shape)
    for name, index in structure.places.items():
        entry = mapping(entries[name], name, _ENTRY_KEYS)
        values[index] = _number(entry["value"], f"the value of {name}")
        unknown = entry["sigma"] in _INFINITY
        sigma[index] = math.inf if unknown else _number(entry["sigma"], f"the sigma of {name}")
        if sigma[index] < 0.0:
            raise EntryError(f"the sigma of {name} is negative")
    t_ns = nanoseconds(top["stamp"], NS_PER_S, BEYOND_INT64_NS, "stamp")
    return CoefficientSet(structure.name, values, sigma, t_ns)


def _notes(content: Mapping[str, Any]) -> Notes:
    """Return the notes from the checked optional entries."""
    delay, lag = _lateness(content, "delay"), _lateness(content, "servo_lag")
    usable = content.get("usable")
    if usable not in (None, "true", "false"):
        raise EntryError(f"usable is '{usable}', not true or false")
    learned_with = content.get("learned_with", {})
    if not isinstance(learned_with, dict):
        raise EntryError("learned_with must be a mapping")
    saved = _time(content["saved"]) if "saved" in content else None
    texts = {name: str(value) for name, value in learned_with.items()}
    return Notes(saved, None if usable is None else usable == "true", delay, texts, lag)


def _lateness(content: Mapping[str, Any], name: str) -> float | None:
    if name not in content:
        return None
    value = _number(content[name], name)
    if not 0.0 <= value <= MAX_DELAY:
        raise EntryError(f"{name} is {value:g}: allowed is 0 to {MAX_DELAY:g} s")
    return value


def _number(text: Any, what: str) -> float:
    number = float(text) if isinstance(text, str) and _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(number):
        raise EntryError(f"{what} is '{text}', not a finite number")
    return number


def _time(text: Any) -> datetime:
    try:
        time = datetime.fromisoformat(text)
    except (ValueError, TypeError):
        raise EntryError(f"saved is '{text}', not a time like 2023-11-14T22:13:25Z") from None
    if time.tzinfo is None:
        raise EntryError(f"saved is '{text}', without a time zone: add Z for UTC")
    return time
