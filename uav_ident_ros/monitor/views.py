# SPDX-License-Identifier: Apache-2.0
"""Where the picture goes: a screen that is drawn in place, or blocks of plain text."""

from __future__ import annotations

import sys
from typing import Protocol

from rich.console import Console
from rich.live import Live

from uav_ident_ros.monitor.heard import Heard
from uav_ident_ros.monitor.picture import picture


class View(Protocol):
    """Shows what has been heard."""

    period: float
    """Seconds between two pictures."""

    def show(self, heard: Heard) -> None:
        """Show the newest."""

    def close(self) -> None:
        """Leave the terminal as it was."""


class _Plain(Console):
    """A console that leaves a reader who has gone to its caller; rich's own exits with 1."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


class Blocks:
    """A block of plain lines each time, for pipes, logs and simple terminals."""

    period = 1.0

    def __init__(self) -> None:
        self._console = _Plain(force_terminal=False, color_system=None, highlight=False)
        self._first = True

    def show(self, heard: Heard) -> None:
        """Print a block; blocks are an empty line apart."""
        if not self._first:
            self._console.print()
        self._console.print(picture(heard, self._console))
        self._console.file.flush()
        self._first = False

    def close(self) -> None:
        """Nothing to leave behind."""


class Screen:
    """The whole terminal, drawn in place."""

    period = 0.5

    def __init__(self) -> None:
        self._console = Console()
        self._live = Live(
            console=self._console, screen=True, auto_refresh=False, vertical_overflow="crop"
        )
        self._live.start()

    def show(self, heard: Heard) -> None:
        """Draw everything anew, in the size that the terminal has now."""
        self._live.update(picture(heard, self._console), refresh=True)

    def close(self) -> None:
        """Give the terminal back."""
        self._live.stop()


def make_view(as_text: bool) -> View:
    """Return the screen where there is one, blocks elsewhere or if `as_text` is set."""
    return Blocks() if as_text or not sys.stdout.isatty() else Screen()
