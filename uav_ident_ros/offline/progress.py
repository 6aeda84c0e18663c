# SPDX-License-Identifier: Apache-2.0
"""Bars for long work, on a terminal that can show them."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from uav_ident_ros.bags.reading import Message


def bar(**options: Any) -> Any:
    """Return a tqdm bar on the error stream; None without a terminal or without tqdm."""
    if not sys.stderr.isatty():
        return None
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm(leave=False, **options)


def of_messages(messages: Iterable[Message], total: int) -> Iterable[Message]:
    """Show how many of the `total` messages have passed."""
    shown: Iterable[Message] | None = bar(
        iterable=messages, total=total, unit=" messages", unit_scale=True
    )
    return messages if shown is None else shown
