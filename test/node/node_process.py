# SPDX-License-Identifier: Apache-2.0
"""What the tests of a running node share."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from signal import Signals

from uav_ident_ros.process import NodeProcess

PATIENCE = 120.0
"""Seconds after which something that must happen is missed: nothing waits for them otherwise, and
a machine with much other work may need them."""

StartNode = Callable[..., NodeProcess]


def wait_for(condition: Callable[[], bool], timeout: float = PATIENCE) -> bool:
    """Wait until `condition` holds; return whether it does."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def handled(pid: int, number: Signals) -> bool:
    """Whether a process has a handler for a signal."""
    caught = re.search(r"SigCgt:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())
    return caught is not None and bool(int(caught[1], 16) >> (number - 1) & 1)
