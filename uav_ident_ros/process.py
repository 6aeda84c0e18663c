# SPDX-License-Identifier: Apache-2.0
"""A node in a separate process, and a ROS domain for a program and its children."""

import os
import secrets
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

HIGHEST_DOMAIN = 101
"""Highest ROS domain with ports below the system's ephemeral ones."""

CLAIM = "\0uav_ident_ros/domain/{}"
"""Abstract socket that reserves a domain; one process owns it, and its end releases it."""


@contextmanager
def own_domain() -> Iterator[int]:
    """Restrict the traffic of this process and its children to this machine and one domain.

    Yields the domain, which no other such process of this machine uses.
    """
    with _claimed() as chosen:
        own = {"ROS_DOMAIN_ID": str(chosen), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        before = {name: os.environ.get(name) for name in own}
        os.environ.update(own)
        try:
            yield chosen
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name)
                else:
                    os.environ[name] = value


@contextmanager
def _claimed() -> Iterator[int]:
    """Reserve a domain and yield it; the search starts at random, to avoid collisions."""
    first = secrets.randbelow(HIGHEST_DOMAIN)
    for offset in range(HIGHEST_DOMAIN):
        domain = 1 + (first + offset) % HIGHEST_DOMAIN
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                claim.bind(CLAIM.format(domain))
            except OSError:
                continue
            yield domain
            return
    raise RuntimeError(f"all {HIGHEST_DOMAIN} ROS domains of this machine are taken")


# --- a node ---------------------------------------------------------------------------------------


END_TIME = 30.0
"""Longest time for a process to end, s, sufficient on a busy machine."""


class NodeProcess(subprocess.Popen[bytes]):
    """A running node; as a context manager it ends the process in any case."""

    def __init__(
        self,
        module: str,  # Python module of the node
        log: Path,  # File to which its output is appended
        parameters: Mapping[str, object],  # By name, as YAML; they override those of the file
        *,
        file: Path | None = None,  # Parameter file
        remappings: Mapping[str, str] | None = None,  # Topics, by their names in the node
        home: Path | None = None,  # Folder for the files of nodes, in place of ROS's
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
        """Return the output up to now."""
        return self.log_file.read_text(encoding="utf-8", errors="replace")

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal, and SIGKILL after `END_TIME`; return the exit status."""
        if self.poll() is None:
            self.send_signal(number)
        try:
            return self.wait(END_TIME)
        except subprocess.TimeoutExpired:
            self.kill()
            return self.wait()

    def __exit__(self, *_: object) -> None:
        self.end()
