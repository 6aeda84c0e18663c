# SPDX-License-Identifier: Apache-2.0
"""Where the picture goes: a screen that is drawn in place, or blocks of plain text."""

import sys

from rich.console import Console
from rich.live import Live

from uav_ident_ros.monitor.heard import Heard
from uav_ident_ros.monitor.picture import picture


class _Plain(Console):
    """A console that leaves a reader who has gone to its caller; rich's own exits with 1."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


class View:
    """Shows what has been heard: on the whole terminal, or in plain lines where there is none."""

    def __init__(
        self,
        plain: bool = False,  # Plain lines on a terminal too
    ) -> None:
        self._screen: Live | None = None
        self.period = 1.0  # Seconds between two pictures
        if plain or not sys.stdout.isatty():
            self._console: Console = _Plain(
                force_terminal=False, color_system=None, highlight=False
            )
        else:
            self._console, self.period = Console(), 0.5
            self._screen = Live(
                console=self._console, screen=True, auto_refresh=False, vertical_overflow="crop"
            )
            self._screen.start()
        self._gap = ""

    def show(self, heard: Heard) -> None:
        """Show the newest: drawn anew, in the size that the terminal has now, or in a block."""
        shown = picture(heard, self._console)
        if self._screen is not None:
            self._screen.update(shown, refresh=True)
            return
        self._console.print(self._gap, end="")
        self._console.print(shown)
        self._console.file.flush()
        self._gap = "\n"  # blocks are an empty line apart

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._screen is not None:
            self._screen.stop()
