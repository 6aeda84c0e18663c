# SPDX-License-Identifier: Apache-2.0
"""Binary logs whose messages follow one another: which bytes are messages, over damaged places."""

import re
from array import array
from collections.abc import Sequence

from uav_ident_ros.import_logs.log import Log

Gap = tuple[int, int]
"""Where bytes that are no message begin and end."""

CUT_OFF = "the file is cut off at its end: what is there was read"


class BinaryLog:
    """What a format has to say of itself, for its messages to be found over damaged places."""

    begins: re.Pattern[bytes]  # Matches where a message may begin that is certain to be one

    def __init__(self, data: bytes) -> None:
        self.data, self.size = data, len(data)

    def length(self, at: int) -> int:
        """Return the length of the message that begins here, bytes; 0 if none does."""
        raise NotImplementedError

    def is_misread(self, last: int, at: int, following: int) -> bool:
        """Whether the type of the last message is what is damaged, and not what begins behind it.

        It may have led to no message (at), although it ends before the following one.
        """
        return False

    def learn(self, at: int, length: int) -> None:
        """Take what the message that begins here says of those that follow."""
        raise NotImplementedError

    def rest(self, at: int) -> str | None:
        """Say what the bytes from here to the end are, in a sentence or none; None if damage."""
        raise NotImplementedError

    def walk(self, start: int) -> tuple[Sequence[int], list[Gap]]:
        """Return where messages begin, and the gaps between them.

        A message is taken if it begins where the one before it ends, or, behind a gap, where one
        begins for certain. What has led to no message was none itself, if it reaches into the one
        that follows.
        """
        places, gaps = array("q"), list[Gap]()
        at = last = start
        while at < self.size:
            if length := self.length(at):
                self.learn(at, length)
                places.append(at)
                at, last = at + length, at
                continue
            taken = last < at
            following = self._next_certain(last + 1 if taken else at + 1)
            if taken and (following < at or self.is_misread(last, at, following)):
                at = places.pop()
            gaps.append((at, following))
            at = last = following
        return places, gaps

    def _next_certain(self, start: int) -> int:
        """Return where the next two messages follow each other, or one ends the file."""
        for found in self.begins.finditer(self.data, start):
            end = found.start() + (length := self.length(found.start()))
            if length and (end == self.size or self.length(end)):
                return found.start()
        return self.size

    def note_loss(self, log: Log, gaps: list[Gap]) -> None:
        """Say how much of the file could not be read, once the samples are in the log."""
        if gaps and gaps[-1][1] == self.size and (rest := self.rest(gaps[-1][0])) is not None:
            gaps.pop()
            log.findings.lost += [rest] if rest else []
        if not gaps:
            return
        share = sum(end - begin for begin, end in gaps) / self.size
        seconds = share * (log.end_ns - log.start_ns) * 1e-9
        log.findings.damage.insert(
            0,
            f"the file is damaged: {round(share * self.size)} of {self.size} bytes "
            f"({100.0 * share:.2g} %) in {len(gaps)} place{'s' if len(gaps) > 1 else ''}, about "
            f"{seconds:.2g} s of the log, could not be read; all the rest was",
        )
