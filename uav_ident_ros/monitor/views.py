# SPDX-License-Identifier: Apache-2.0
"""Where the lines go: a screen that is drawn anew, or blocks of plain text."""

from __future__ import annotations

import shutil
import sys
from typing import Protocol

from uav_ident_ros.monitor.heard import Heard
from uav_ident_ros.monitor.lines import glyphs_for, lines, plain

NO_RICH = (
    "monitor: a block of text every second, as the package 'rich' is not installed: "
    "python3-rich from apt, or the extra 'monitor' from pip"
)


class View(Protocol):
    """Shows what has been heard."""

    period: float
    """Seconds between two pictures."""

    def show(self, heard: Heard) -> None:
        """Show the newest."""

    def close(self) -> None:
        """Leave the terminal as it was."""


class Blocks:
    """A block of plain lines each time, for pipes, logs and simple terminals."""

    period = 1.0

    def __init__(self) -> None:
        self._first = True

    def show(self, heard: Heard) -> None:
        """Print a block; blocks are an empty line apart."""
        width = shutil.get_terminal_size().columns
        block = [plain(line) for line in lines(heard, width, glyphs_for(sys.stdout.encoding))]
        print("\n".join(block if self._first else ["", *block]), flush=True)
        self._first = False

    def close(self) -> None:
        """Nothing to leave behind."""


class Screen:
    """The whole terminal, drawn in place; needs the package `rich`.

    Raises
    ------
    ImportError
        If it is not installed.
    """

    period = 0.5

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._console = Console()
        self._live = Live(console=self._console, screen=True, auto_refresh=False)
        self._live.start()

    def show(self, heard: Heard) -> None:
        """Draw everything anew, in the size that the terminal has now."""
        from rich.text import Text

        drawn = lines(heard, self._console.width, glyphs_for(self._console.encoding))
        text = Text("\n", no_wrap=True, overflow="crop").join(
            Text.assemble(*line) for line in drawn[: self._console.height]
        )
        self._live.update(text, refresh=True)

    def close(self) -> None:
        """Give the terminal back."""
        self._live.stop()


def make_view(as_text: bool) -> View:
    """Return the screen where there is one, blocks elsewhere or if `as_text` is set."""
    if as_text or not sys.stdout.isatty():
        return Blocks()
    try:
        return Screen()
    except ImportError:
        print(NO_RICH, file=sys.stderr)
        return Blocks()
