# SPDX-License-Identifier: Apache-2.0
"""Saving coefficients while the node runs: in a thread, never in a tick."""

from __future__ import annotations

import os
import threading
from pathlib import Path

from uav_ident_ros.coefficients_file import CoefficientsFileError, save_coefficients
from uav_ident_ros.identification.estimate import CoefficientSet

ANSWER_WITHIN = 0.02
"""Seconds that a service call may wait for the disk: less than half a tick."""


def default_path(node_name: str) -> Path:
    """Return where a node keeps its coefficients unless told otherwise.

    Parameters
    ----------
    node_name : str
        Full name of the node: two vehicles never share a file.
    """
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    return home / "uav_ident_ros" / f"{node_name.strip('/').replace('/', '.')}.yaml"


class Saver:
    """Writes coefficients to a file, one at a time.

    Parameters
    ----------
    path : Path
        The file; its folder is made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._thread: threading.Thread | None = None
        self._problem = ""

    def save(self, coefficients: CoefficientSet) -> tuple[bool, str]:
        """Begin to write `coefficients`.

        Returns
        -------
        (bool, str)
            Whether they are written or being written, and a line that says which.
        """
        if self._thread is not None and self._thread.is_alive():
            return False, f"still writing '{self.path}'"
        self._thread = threading.Thread(target=self._write, args=(coefficients,))
        self._thread.start()
        self._thread.join(ANSWER_WITHIN)
        if self._thread.is_alive():
            return True, f"writing '{self.path}'"
        if self._problem:
            return False, self._problem
        return True, f"saved to '{self.path}'"

    def _write(self, coefficients: CoefficientSet) -> None:
        self._problem = ""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            save_coefficients(coefficients, self.path)
        except CoefficientsFileError as error:
            self._problem = str(error)
        except OSError as error:
            self._problem = f"cannot make the folder of '{self.path}': {error.strerror}"
