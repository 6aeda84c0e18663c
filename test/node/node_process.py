# SPDX-License-Identifier: Apache-2.0
"""Run `identifier` as a process of its own."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[2]

PATIENCE = 120.0
"""Seconds after which something that must happen is missed: nothing waits for them otherwise, and
a machine with much other work may need them."""


class NodeProcess:
    """`identifier` as a process of its own."""

    def __init__(self, arguments: list[str], home: Path | None = None) -> None:
        self._errors = tempfile.TemporaryFile(mode="w+")  # noqa: SIM115  (closed in `kill`)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "uav_ident_ros.node", *arguments],
            cwd=ROOT,
            env={**os.environ, **({"ROS_HOME": str(home)} if home else {})},
            stdout=self._errors,
            stderr=subprocess.STDOUT,
        )

    @property
    def log(self) -> str:
        """Everything it has printed."""
        self._errors.seek(0)
        return self._errors.read()

    def end(self, signal_number: int, timeout: float = PATIENCE) -> int:
        """Send a signal and return the exit status."""
        self.process.send_signal(signal_number)
        return self.process.wait(timeout)

    def exit_status(self, timeout: float = PATIENCE) -> int:
        """Wait for it to end by itself."""
        return self.process.wait(timeout)

    def kill(self) -> None:
        """Make sure that nothing is left."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(5.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._errors.close()


StartNode = Callable[..., NodeProcess]


def wait_for(condition: Callable[[], bool], timeout: float = PATIENCE) -> bool:
    """Wait until `condition` holds; return whether it does."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True
