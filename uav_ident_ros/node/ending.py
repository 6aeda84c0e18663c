# SPDX-License-Identifier: Apache-2.0
"""Orderly end of a program on a signal."""

import ctypes
import signal

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals of Ctrl-C; of ``kill``, systemd and launch; of a closed terminal or ssh connection."""


class Ending:
    """Handler of the signals that end a program: it records the first and interrupts nothing.

    ROS's own handlers shut the context down during publishing. Python's raise an exception at any
    point, for example during the writing of a file. One Ctrl-C often arrives twice: from the
    terminal and from launch.
    """

    def __init__(self) -> None:
        self.requested = False  # Whether a signal has requested the end
        self._before = {number: signal.getsignal(number) for number in ENDING_SIGNALS}
        for number in ENDING_SIGNALS:
            # nohup and setsid ignore SIGHUP, so that the program outlives the terminal
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._request)

    def _request(self, *_: object) -> None:
        self.requested = True

    def restore(self) -> None:
        """Restore the former handlers, for a program that continues."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def close(self) -> None:
        """Ignore further signals: Python would restore the default handlers as it ends.

        The signals are ignored in the system first, then in Python. In Python alone, a signal
        between its two steps would call a handler that no longer exists, with a traceback.
        """
        set_handler = ctypes.pythonapi.PyOS_setsig
        set_handler.argtypes, set_handler.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
        for number in ENDING_SIGNALS:
            set_handler(number, int(signal.SIG_IGN))
            signal.signal(number, signal.SIG_IGN)
