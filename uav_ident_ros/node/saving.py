# SPDX-License-Identifier: Apache-2.0
"""Saving coefficients while the node runs: in a thread, never in a tick."""

from __future__ import annotations

import threading
from pathlib import Path

from uav_ident_ros.files.coefficients_file import CoefficientsFileError, Notes, save_coefficients
from uav_ident_ros.identification.estimate import CoefficientSet

ANSWER_WITHIN = 0.02
"""Seconds that a service call may wait for the disk: less than half a tick."""

FINISH_WITHIN = 10.0
"""Seconds that the end of the program may wait for a disk that hangs."""

ASIDE = ".refused"
"""Added to the name of a file that could not be used, before another takes its place."""


class Saver:
    """Writes coefficients to a file, one at a time."""

    def __init__(
        self,
        path: Path,  # The file; its folder is made
    ) -> None:
        self.path = path
        self.written: CoefficientSet | None = None  # What was written last
        # Whether the file that is there is none of ours, and is kept under another name
        self.set_aside = False
        # Whether somebody else wrote the file since this saver looked at it or wrote it
        self.shared = False
        self._seen = self._state()
        self._thread: threading.Thread | None = None
        self._problem = ""

    def save(self, coefficients: CoefficientSet, notes: Notes) -> tuple[bool, str]:
        """Begin to write `coefficients`.

        Returns
        -------
        (bool, str)
            Whether they are written or being written, and a line that says which.
        """
        if self._busy():
            return False, f"still writing '{self.path}'"
        self._thread = threading.Thread(target=self._write, args=(coefficients, notes))
        self._thread.start()
        self._thread.join(ANSWER_WITHIN)
        if self._busy():
            return True, f"writing '{self.path}'"
        return self._outcome()

    def finish(self, coefficients: CoefficientSet, notes: Notes) -> tuple[bool, str]:
        """Write `coefficients` at the end of the program; values as of `save`."""
        if self._thread is not None:
            self._thread.join(FINISH_WITHIN)
        if self._busy():
            return False, f"the disk does not answer: '{self.path}' keeps what it held"
        self._write(coefficients, notes)
        return self._outcome()

    def problem(self) -> str:
        """Return what went wrong with the last file, once; empty if nothing did."""
        if self._busy():
            return ""
        problem, self._problem = self._problem, ""
        return problem

    def _busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _outcome(self) -> tuple[bool, str]:
        problem = self.problem()
        return (False, problem) if problem else (True, f"saved to '{self.path}'")

    def _write(self, coefficients: CoefficientSet, notes: Notes) -> None:
        self._problem = ""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.set_aside and self.path.is_file():
                self.path.replace(self.path.with_name(self.path.name + ASIDE))
            self.set_aside = False
            self.shared = self.shared or self._state() not in (None, self._seen)
            save_coefficients(coefficients, self.path, notes)
            self._seen = self._state()
            self.written = coefficients
        except CoefficientsFileError as error:
            self._problem = str(error)
        except OSError as error:
            self._problem = f"cannot write '{self.path}': {error.strerror}"

    def _state(self) -> tuple[int, int] | None:
        """Return what tells one version of the file from another; None if there is none."""
        try:
            status = self.path.stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns
