# SPDX-License-Identifier: Apache-2.0
"""Common parts of the commands: error messages of one line, and the end by a signal."""

import argparse
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn, TypeVar

USAGE_ERROR = 2
"""Exit status for a wrong command line or bad input."""

INTERRUPTED = 130
"""Exit status after Ctrl-C, as in shells."""


class OneLineParser(argparse.ArgumentParser):
    """An argument parser with error messages of one line."""

    def error(self, message: str) -> NoReturn:
        """Exit with the error message and a hint at ``--help``."""
        self.exit(USAGE_ERROR, f"{self.prog}: {message} (see {self.prog} --help)\n")


Number = TypeVar("Number", int, float)


def number(
    kind: Callable[[str], Number],  # ``int`` or ``float``
    least: Number,  # least, most: The range
    most: Number,
    suffix: str,  # Text after a refused value in the error message
) -> Callable[[str], Number]:
    """Return the type of an argument that is a number in a range."""

    def read(text: str) -> Number:
        with suppress(ValueError):
            if least <= (value := kind(text)) <= most:
                return value
        raise argparse.ArgumentTypeError(f"'{text}'{suffix}")

    return read


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def end_as_on_ctrl_c() -> None:
    """Treat SIGTERM and SIGHUP as Ctrl-C: children end, the terminal is restored.

    A signal that is ignored, as SIGHUP under nohup, stays so.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def reader_has_gone() -> None:
    """Redirect further output to /dev/null after a broken pipe: else Python's exit reports it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
