# SPDX-License-Identifier: Apache-2.0
"""A node for a tool that listens to others: the monitor, and the player of recordings."""

import time
from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

LOOK_EVERY = 0.02
"""Seconds between two looks at a condition."""


class Guest:
    """A node in a context of its own: without signal handlers Ctrl-C stays a KeyboardInterrupt."""

    def __init__(
        self,
        name: str,  # Its name
        **options: Any,  # Further arguments of `rclpy.node.Node`
    ) -> None:
        context = Context()
        context.init(args=[])
        self.node = Node(
            name, context=context, use_global_arguments=False, enable_rosout=False, **options
        )
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        self.node.context.try_shutdown()

    def spin_for(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Listen for a while, or until a condition holds; return whether it does."""
        end = time.monotonic() + seconds
        while until is None or not until():
            left = end - time.monotonic()
            if left <= 0.0:
                return False
            self._executor.spin_once(timeout_sec=left if until is None else min(left, LOOK_EVERY))
        return True
