# SPDX-License-Identifier: Apache-2.0
"""The state file: the coefficients of the node, kept from one flight to the next."""

import json
import math
import os
from concurrent.futures import Future, ThreadPoolExecutor, wait
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from uav_ident_ros.files.coefficients_file import (
    CoefficientsFileError,
    Notes,
    load_with_notes,
    remove_leftovers,
    save_coefficients,
)
from uav_ident_ros.files.strict_yaml import problem
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import NO_FILE, Settings, SettingsError

ANSWER_WITHIN = 0.02
"""Longest wait of a service call for the disk, s: less than half a tick."""

FINISH_WITHIN = 10.0
"""Longest wait for the disk at the end of the program, s."""

ASIDE = ".refused"
"""Suffix for an unusable file that is renamed before a new one is written."""

MEANING = (
    "imu.convention",
    "imu.rpy",
    "actuators.type",
    "actuators.field",
    "actuators.channels",
    "actuators.scale",
    "actuators.mixing.de",
    "actuators.mixing.dr",
    "actuators.mixing.da",
    "actuators.mixing.dth",
    "airspeed.reference",
)
"""Settings that define the meaning of the coefficients: with others a file is not usable."""


def state_path(settings: Settings, node_name: str) -> Path | None:
    """Return the path of the state file of the node of this full name; None if it has none."""
    if settings.state_file == NO_FILE:
        return None
    if settings.state_file:
        return Path(settings.state_file).expanduser().absolute()
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    return home / "uav_ident_ros" / f"{node_name.strip('/').replace('/', '.')}.yaml"


def read_state(
    path: Path, settings: Settings, now: datetime
) -> tuple[CoefficientSet, Notes, timedelta]:
    """Return coefficients, notes and age of a state file; raise if too old or of other settings.

    The age is by the computer's clock, since message time may be simulated. It is negative if that
    clock was set back.
    """
    modified = path.stat().st_mtime
    coefficients, notes = load_with_notes(path, settings.structure)
    # A file written by hand or by replay has no time: the file's modification time counts.
    age = now - (notes.saved or datetime.fromtimestamp(modified, UTC))
    if 0.0 < settings.state_max_age < age.total_seconds():
        raise CoefficientsFileError(
            f"it was saved {in_words(age)} ago, and 'state_max_age' is "
            f"{in_words(timedelta(seconds=settings.state_max_age))}"
        )
    meaning = _meaning(settings)
    for name, value in notes.learned_with.items():
        if meaning.get(name, value) != value:
            raise CoefficientsFileError(
                f"it was learned with '{name}' {value}, which is now {meaning[name]}"
            )
    return coefficients, notes, age


def _meaning(settings: Settings) -> dict[str, str]:
    values = settings.values()
    return {name: json.dumps(values[name]) for name in MEANING}


def in_words(span: timedelta) -> str:
    """Return a time span as text, in its largest unit."""
    seconds = span.total_seconds()
    for name, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if abs(seconds) >= 2.0 * length:
            return f"{seconds / length:.0f} {name}"
    return f"{seconds:.0f} s"


class Memory:
    """Reads and writes the state file of a node.

    The file is written on request, at the end, and at intervals while the coefficients are usable.
    Coefficients that are not usable replace usable ones only on request. A thread writes, one file
    at a time, since a disk may be slow.
    """

    def __init__(self, identifier: OnlineIdentifier, node_name: str, log: RcutilsLogger) -> None:
        self._identifier, self._log = identifier, log
        self._path = state_path(identifier.settings, node_name)
        self._refused = False  # Whether the present file is unusable and must be kept as `ASIDE`
        self._disk = ThreadPoolExecutor(1)
        self._writing: Future[tuple[CoefficientSet, bool]] | None = None
        self._last_save = -math.inf
        self.forget()

    def start(self, now: datetime | None = None) -> None:
        """Start warm from a usable state file; log the problem of an unusable one."""
        if (path := self._path) is None:
            return
        try:
            remove_leftovers(path)
            held, notes, age = read_state(path, self._identifier.settings, now or datetime.now(UTC))
            self._identifier.resume(held, notes.delay, notes.servo_lag)
        except FileNotFoundError:
            # Warn before the flight if the file cannot be written.
            place = next(folder for folder in path.parents if folder.exists())
            if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
                self._log.warning(f"cannot write '{path}': nothing can be written in '{place}'")
            return
        except (CoefficientsFileError, SettingsError, OSError) as error:
            self._refused = True
            line = problem(error)
            line = line if str(path) in line else f"state file '{path}': {line}"
            self._log.warning(f"starting cold: {line}")
            return
        self._holds_usable, self._known = bool(notes.usable), held
        saved = f", saved {in_words(age)} ago"
        if age < timedelta(0):
            saved = ""
            self._log.warning(
                f"the computer's clock is {in_words(-age)} behind the state file '{path}': its age "
                "cannot be judged"
            )
        self._log.info(f"started from '{path}'{saved}")

    def forget(self) -> None:
        """Allow any new coefficients to replace the file, after a reset."""
        self._look(ANSWER_WITHIN)
        self._holds_usable = False
        # coefficients that need no saving: those of the file, or of a cold start
        self._known = self._identifier.coefficient_set()

    def save(self, estimate: Estimate | None, *, last: bool = False) -> tuple[bool, str]:
        """Write the coefficients now, usable or not; wait for the `last` ones.

        Return the success (written, or being written) and a message.
        """
        if (path := self._path) is None:
            return False, f"there is no file to save to: 'state_file' is '{NO_FILE}'"
        if estimate is None:
            return False, "there is no estimate to save yet"
        self._look()
        if self._writing is not None:
            return False, f"the disk does not answer: still writing '{path}'"
        lag, configured = self._identifier.lag, self._identifier.settings.actuators.time_constant
        notes = Notes(
            saved=datetime.now(UTC),
            usable=estimate.usable,
            delay=self._identifier.delay,
            learned_with=_meaning(self._identifier.settings),
            servo_lag=None if lag == configured else lag,
        )
        coefficients = self._identifier.coefficient_set(estimate.t_ns)
        self._writing = self._disk.submit(self._write, path, coefficients, notes)
        if failed := self._outcome(None if last else ANSWER_WITHIN):
            return False, failed
        return True, f"writing '{path}'" if self._writing else f"saved to '{path}'"

    def _write(
        self, path: Path, coefficients: CoefficientSet, notes: Notes
    ) -> tuple[CoefficientSet, bool]:
        path.parent.mkdir(parents=True, exist_ok=True)
        if self._refused and path.is_file():
            path.replace(path.with_name(path.name + ASIDE))
        self._refused = False
        save_coefficients(coefficients, path, notes)
        return coefficients, bool(notes.usable)

    def _outcome(self, patience: float | None) -> str:
        """Wait for the thread and record its result; return the error, empty if none."""
        if self._writing is None or wait([self._writing], patience).not_done:
            return ""
        done, self._writing = self._writing, None
        try:
            self._known, self._holds_usable = done.result()
        except CoefficientsFileError as error:
            return str(error)
        except FileExistsError as error:  # where the folder should be
            return f"cannot write '{self._path}': '{error.filename}' is no folder"
        except OSError as error:
            return f"cannot write '{self._path}': {error.strerror}"
        self._identifier.note_saved(self._known)
        return ""

    def _look(self, patience: float = 0.0) -> None:
        if failed := self._outcome(patience):
            self._log.error(failed)

    def attend(self, estimate: Estimate | None, now: float) -> None:
        """Save usable coefficients if due; call it each second with a steady clock's time, s."""
        self._look()
        due = 0.0 < self._identifier.settings.save_period <= now - self._last_save
        if due and estimate is not None and estimate.usable:
            self._last_save = now
            self._save_changes(estimate)

    def finish(self, estimate: Estimate | None) -> None:
        """Write the coefficients at the end of the program, after those that are being written."""
        self._look(FINISH_WITHIN)
        if estimate is not None and (estimate.usable or not self._holds_usable):
            self._save_changes(estimate, last=True)

    def _save_changes(self, estimate: Estimate, *, last: bool = False) -> None:
        """Save coefficients that differ from those of the file; log a failure, and the end."""
        values = self._identifier.coefficient_set(estimate.t_ns).values
        if self._path is None or np.array_equal(values, self._known.values):
            return
        done, line = self.save(estimate, last=last)
        if not done:
            self._log.error(line)
        elif last:
            self._log.info(line)
