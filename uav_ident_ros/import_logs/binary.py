# SPDX-License-Identifier: Apache-2.0
"""Location of the messages in a binary log, in spite of damaged bytes."""

import re
from array import array
from collections.abc import Sequence

from uav_ident_ros.identification.samples import NS
from uav_ident_ros.import_logs.log import Log

Gap = tuple[int, int]
"""Start and end of bytes that are no message."""

CUT_OFF = "the file is cut off at its end: the part before was read"


class BinaryLog:
    """A binary log of consecutive messages; each format defines the abstract methods."""

    begins: re.Pattern[bytes]  # Matches possible starts of a message behind a gap

    def __init__(self, data: bytes) -> None:
        self.data, self.size = data, len(data)

    def length(self, at: int) -> int:
        """Return the length of the message that starts here, bytes; 0 if none does."""
        raise NotImplementedError

    def is_misread(self, last: int, at: int, following: int) -> bool:
        """Return whether the type of the last message is damaged, rather than the bytes behind it.

        No message begins at its end, `at`; the next certain one begins at `following`.
        """
        return False

    def register(self, at: int, length: int) -> None:
        """Store the declarations in the message that begins here; later messages rely on them."""
        raise NotImplementedError

    def rest(self, at: int) -> str | None:
        """Return a remark on the bytes from here to the end, '' if harmless; None if damaged."""
        raise NotImplementedError

    def walk(self, start: int) -> tuple[Sequence[int], list[Gap]]:
        """Return the start positions of the messages, and the gaps between them.

        A message counts if it starts at the end of the one before or, behind a gap, if it is
        certain (`_next_certain`). One before a gap does not count if it overlaps the next.
        """
        places, gaps = array("q"), list[Gap]()
        at = last = start
        while at < self.size:
            if length := self.length(at):
                self.register(at, length)
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
        """Return the start of the next message that ends at another one or at the end of file."""
        for found in self.begins.finditer(self.data, start):
            end = found.start() + (length := self.length(found.start()))
            if length and (end == self.size or self.length(end)):
                return found.start()
        return self.size

    def note_loss(self, log: Log, gaps: list[Gap]) -> None:
        """Add the unreadable share of the file to the findings; `log` must have its samples."""
        if gaps and gaps[-1][1] == self.size and (rest := self.rest(gaps[-1][0])) is not None:
            gaps.pop()
            log.findings.lost += [rest] if rest else []
        if not gaps:
            return
        share = sum(end - begin for begin, end in gaps) / self.size
        seconds = share * (log.end_ns - log.start_ns) * NS
        log.findings.damage.insert(
            0,
            f"the file is damaged: {round(share * self.size)} of {self.size} bytes "
            f"({100.0 * share:.2g} %) in {len(gaps)} place{'s' if len(gaps) > 1 else ''}, about "
            f"{seconds:.2g} s of the log, could not be read; all the rest was",
        )
