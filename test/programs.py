# SPDX-License-Identifier: Apache-2.0
"""Programs as tests run them: in a process of their own, or by their main function."""

import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from repository import ROOT

Capture = pytest.CaptureFixture[str]
"""What a test reads that a program printed."""


def python(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python in the repository and keep what it prints."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, **options)


def refusal(main: Callable[[Sequence[str]], int], arguments: Sequence[str], capsys: Capture) -> str:
    """The one line with which a program refuses its arguments."""
    try:
        status: Any = main(arguments)
    except SystemExit as ended:
        status = ended.code
    printed = capsys.readouterr()
    assert (status, printed.out) == (2, ""), printed
    (line,) = printed.err.splitlines()
    return str(line)
