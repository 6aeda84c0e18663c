# SPDX-License-Identifier: Apache-2.0
"""The end of a program that was asked to end: once, in order, whatever signals follow."""

import ctypes
import signal

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C; ``kill``, systemd and launch; the terminal or the ssh connection that is gone."""


class Ending:
    """Takes the signals that ask a program to end: the first is noted, none interrupts anything.

    ROS's own handlers shut the context down under whoever publishes, and Python's raise in the
    middle of whatever runs, the writing of a file for example. One Ctrl-C often arrives twice:
    from the terminal and from launch.
    """

    def __init__(self) -> None:
        self.requested = False  # Whether the program was asked to end
        self._before = {number: signal.getsignal(number) for number in SIGNALS}
        for number in SIGNALS:
            # nohup and setsid: who ignores the terminal's end wants to outlive it.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._request)

    def _request(self, *_: object) -> None:
        self.requested = True

    def restore(self) -> None:
        """Let others take the signals again, for a program that goes on."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def close(self) -> None:
        """Ignore what still comes: Python would put the deadly handlers back as it ends.

        The system ignores a signal first, and Python then: one that arrives between Python's own
        two steps would still call for a handler that is gone, and leave a traceback.
        """
        set_handler = ctypes.pythonapi.PyOS_setsig
        set_handler.argtypes, set_handler.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
        for number in SIGNALS:
            set_handler(number, int(signal.SIG_IGN))
            signal.signal(number, signal.SIG_IGN)
