# SPDX-License-Identifier: Apache-2.0
"""Programs under test, run in a separate process or by their main function."""

import os
import pty
import re
import select
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from signal import Signals
from typing import Any

import pytest
from repository import ROOT

from uav_ident_ros.process import NodeProcess

PATIENCE = 120.0
"""Time limit of expected events, s. A test waits that long only on failure; a busy machine may
need the time."""

StartNode = Callable[..., NodeProcess]

Capture = pytest.CaptureFixture[str]
"""Fixture with the output of a program."""


def python(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python in the repository; capture its output."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, **options)


def refusal(main: Callable[[Sequence[str]], int], arguments: Sequence[str], capsys: Capture) -> str:
    """Run a program that refuses its arguments; return its error line."""
    try:
        status: Any = main(arguments)
    except SystemExit as ended:
        status = ended.code
    printed = capsys.readouterr()
    assert (status, printed.out) == (2, ""), printed
    (line,) = printed.err.splitlines()
    return str(line)


def wait_for(condition: Callable[[], bool], timeout: float = PATIENCE) -> bool:
    """Wait until `condition` holds; return whether it does."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def handled(pid: int, number: Signals) -> bool:
    """Return whether a process has a handler for a signal."""
    caught = re.search(r"SigCgt:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())
    return caught is not None and bool(int(caught[1], 16) >> (number - 1) & 1)


class Terminal:
    """A program on a terminal of 24 lines; `options` may redirect its streams."""

    def __init__(self, command: list[str], columns: int = 80, **options: Any) -> None:
        self._main, side = pty.openpty()
        termios.tcsetwinsize(side, (24, columns))
        environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "NO_COLOR")}
        environment |= {"TERM": "xterm-256color", "PYTHONIOENCODING": "utf-8"}
        streams = {"stdin": side, "stdout": side, "stderr": side, **options}
        self.process = subprocess.Popen(command, cwd=ROOT, env=environment, **streams)
        os.close(side)
        self.received = ""

    def read_until(self, words: str, timeout: float = PATIENCE) -> bool:
        """Read until the program prints a text or ends; return whether the text came."""
        end = time.monotonic() + timeout
        while words not in self.received and time.monotonic() < end:
            if select.select([self._main], [], [], 0.1)[0]:
                try:
                    self.received += os.read(self._main, 65536).decode(errors="replace")
                except OSError:  # the program has ended
                    break
        return words in self.received

    def close(self) -> None:
        """End the process and close the terminal."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self._main)
