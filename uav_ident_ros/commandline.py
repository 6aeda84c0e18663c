# SPDX-License-Identifier: Apache-2.0
"""What the commands have in common: complaints of one line, and an end by a signal."""

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
"""Exit status after Ctrl-C, as shells have it."""


class OneLineParser(argparse.ArgumentParser):
    """A parser whose complaint is one line."""

    def error(self, message: str) -> NoReturn:
        """End with the complaint, and where to look."""
        self.exit(USAGE_ERROR, f"{self.prog}: {message} (see {self.prog} --help)\n")


Number = TypeVar("Number", int, float)


def number(
    kind: Callable[[str], Number],  # ``int`` or ``float``
    least: Number,  # least, most: What it may be
    most: Number,
    words: str,  # What follows what was given, where that is no such number
) -> Callable[[str], Number]:
    """Return the type of an argument that is a number in a range."""

    def read(text: str) -> Number:
        with suppress(ValueError):
            if least <= (value := kind(text)) <= most:
                return value
        raise argparse.ArgumentTypeError(f"'{text}'{words}")

    return read


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def end_as_on_ctrl_c() -> None:
    """Let SIGTERM do what Ctrl-C does: children and the terminal must not be left behind."""
    signal.signal(signal.SIGTERM, _interrupt)


def reader_has_gone() -> None:
    """Give what is still to be printed nowhere to go: Python would complain of it at the exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
