# SPDX-License-Identifier: Apache-2.0
"""A node of this package as a process of its own, with its output in a file."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

END_TIME = 30.0
"""Seconds that a process may take to end, on a busy machine too."""


class NodeProcess(subprocess.Popen[bytes]):
    """A running node; as a context manager it is ended in any case."""

    def __init__(
        self,
        module: str,  # What it runs
        log: Path,  # Where its output goes, behind what is there
        parameters: Mapping[str, object],  # By name, as YAML; they count for more than the file's
        *,
        file: Path | None = None,  # Parameter file
        remappings: Mapping[str, str] | None = None,  # Topics by their names in the node
        home: Path | None = None,  # For what nodes keep, in place of ROS's
    ) -> None:
        self.log_file = log
        command = [sys.executable, "-m", module, "--ros-args"]
        if file is not None:
            command += ["--params-file", str(file)]
        for name, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ["-p", f"{name}:={text}"]
        for name, topic in (remappings or {}).items():
            command += ["-r", f"{name}:={topic}"]
        environment = {**os.environ, "RCUTILS_LOGGING_BUFFERED_STREAM": "0"}
        if home is not None:
            environment["ROS_HOME"] = str(home)
        with log.open("ab") as output:
            super().__init__(command, stdout=output, stderr=output, env=environment)

    @property
    def log(self) -> str:
        """Everything that it has printed so far."""
        return self.log_file.read_text(encoding="utf-8", errors="replace")

    def end(self, number: int = signal.SIGINT) -> int:
        """Ask it to end, kill it if it does not; return the exit status."""
        if self.poll() is None:
            self.send_signal(number)
        try:
            return self.wait(END_TIME)
        except subprocess.TimeoutExpired:
            self.kill()
            return self.wait()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.end()
