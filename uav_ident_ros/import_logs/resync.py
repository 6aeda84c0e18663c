# SPDX-License-Identifier: Apache-2.0
"""Walks through the messages of a binary log, over damaged places, and says how much they cost."""

from bisect import bisect_left
from collections.abc import Collection, Sequence
from typing import Protocol

Gap = tuple[int, int]
"""Where bytes that are no message begin and end."""


class Format(Protocol):
    """What a walk has to know of a log's format, and whom it tells what it finds."""

    @property
    def lengths(self) -> Collection[int]:
        """Lengths that messages with samples can have, bytes."""

    def length(self, at: int) -> int:
        """Return the length of the message that may begin here, bytes; 0 if none does."""

    def next_certain(self, start: int) -> int:
        """Return the next place where a message begins for certain; else the end of the file."""

    def resembles(self, at: int) -> bool:
        """Return whether what stands here is the begin of a message but for a byte or so."""

    def take(self, at: int) -> None:
        """Take the message that begins here."""

    def take_back(self) -> None:
        """Forget the message taken last: it was none."""


def walk(log: Format, start: int, end: int) -> list[Gap]:
    """Let a log take every message, and return the gaps between them.

    A message is taken if it begins where the one before it ends, or, behind a gap, where one
    begins for certain.
    """
    gaps: list[Gap] = []
    at = last = start
    while at < end:
        if length := log.length(at):
            log.take(at)
            at, last = at + length, at
            continue
        taken = last < at
        following = log.next_certain(last + 1 if taken else at + 1)
        # What has led to no message was none itself, if it reaches into the one that follows, or
        # if with it the gap is as long as a message, and no damaged one begins behind it: then its
        # type is what is damaged.
        misread = following - last in log.lengths and not log.resembles(at)
        if taken and (following < at or misread):
            log.take_back()
            at = last
        gaps.append((at, following))
        at = last = following
    return gaps


def loss_in_words(
    gaps: Sequence[Gap],  # The gaps
    size: int,  # Bytes of the file
    # Place and stamp, ns, of messages, in the order of the file: tells how long the gaps are
    stamped: Sequence[tuple[int, int]],
) -> str:
    """Say how much could not be read."""
    lost = sum(end - begin for begin, end in gaps)
    places = [place for place, _ in stamped]
    lost_ns = 0
    for begin, end in gaps:
        before, after = bisect_left(places, begin) - 1, bisect_left(places, end)
        if before >= 0 and after < len(places):
            lost_ns += max(stamped[after][1] - stamped[before][1], 0)
    return (
        f"the file is damaged: {lost} of {size} bytes ({100.0 * lost / size:.2g} %) in "
        f"{len(gaps)} place{'s' if len(gaps) > 1 else ''}, about {lost_ns * 1e-9:.2g} s of the "
        "log, could not be read; all the rest was"
    )
