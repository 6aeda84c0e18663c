# SPDX-License-Identifier: Apache-2.0
"""The commands, and their common parts: error messages of one line, and the end by a signal."""

import argparse
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import NoReturn, TypeVar

USABLE, NOT_USABLE = 0, 1
"""Exit statuses for the verdict on a model."""

USAGE_ERROR = 2
"""Exit status for a wrong command line or bad input."""

INTERRUPTED = 130
"""Exit status after Ctrl-C, as in shells."""

BROKEN_PIPE = 141
"""Exit status after the end of the reader of a pipe, as in shells."""

LINE_LENGTH = 100
"""Length of the longest line of a text, characters."""

COMMANDS = {
    "demo": "demo",
    "fleet": "offline.fleet_command",
    "import_log": "import_logs.cli",
    "monitor": "monitor.cli",
    "replay": "offline",
    "simulate": "simulation.cli",
}
"""Module of each command. Its `main` takes the arguments and returns the exit status."""

_BOTH = (
    "apt does not have it: run scripts/setup, or in a virtual environment with "
    "--system-site-packages: pip install rosbags mcap"
)
PACKAGE_CURES = {
    "mcap": _BOTH,
    "rich": "install python3-rich from apt, or the extra 'monitor' from pip",
    "rosbags": _BOTH,
}
"""Ways to install a package, if not by pip alone."""


def run(name: str, arguments: Sequence[str] | None = None) -> int:
    """Run a command of `COMMANDS` and return its exit status.

    Neither Ctrl-C nor the end of a pipe's reader, such as ``head``, leaves a traceback.
    """
    try:
        with importing():
            module = import_module(f"uav_ident_ros.{COMMANDS[name]}")
        try:
            return int(module.main(arguments))
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        reader_has_gone()
        return BROKEN_PIPE
    except ModuleNotFoundError as error:
        print(f"{name}: {missing(error)}", file=sys.stderr)
        return USAGE_ERROR


# the programs of setup.py
demo, fleet, import_log, monitor, replay, simulate = (partial(run, name) for name in COMMANDS)


@contextmanager
def importing() -> Iterator[None]:
    """Let Ctrl-C end the program at once: imports may turn a KeyboardInterrupt into an error."""
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def missing(error: ModuleNotFoundError) -> str:
    """Return the package that an import lacks, with the way to install it."""
    package = str(error.name).partition(".")[0]
    cure = PACKAGE_CURES.get(package, f"pip install {package}")
    return f"the Python package '{package}' is missing: {cure}"


class OneLineParser(argparse.ArgumentParser):
    """An argument parser with error messages of one line."""

    def error(self, message: str) -> NoReturn:
        """Exit with the error message and a hint at ``--help``."""
        self.exit(USAGE_ERROR, f"{self.prog}: {message} (see {self.prog} --help)\n")


Numeric = TypeVar("Numeric", int, float)


def number(
    kind: Callable[[str], Numeric],  # ``int`` or ``float``
    least: Numeric,  # least, most: The range
    most: Numeric,
    suffix: str,  # Text after a refused value in the error message
) -> Callable[[str], Numeric]:
    """Return the type of an argument that is a number in a range."""

    def read(text: str) -> Numeric:
        with suppress(ValueError):
            if least <= (value := kind(text)) <= most:
                return value
        raise argparse.ArgumentTypeError(f"'{text}'{suffix}")

    return read


def given_path(text: str) -> Path:
    """Return the path of an argument, which names one: `Path` reads an empty text as the folder."""
    if not text:
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def end_as_on_ctrl_c() -> None:
    """Treat SIGTERM and SIGHUP as Ctrl-C: children end, the terminal is restored.

    A signal that is ignored, as SIGHUP under nohup, stays so.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


def reader_has_gone() -> None:
    """Redirect further output to /dev/null after a broken pipe: else Python's exit reports it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
