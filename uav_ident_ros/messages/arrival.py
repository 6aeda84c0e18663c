# SPDX-License-Identifier: Apache-2.0
"""When messages that carry no time count: from their arrival, on the Imu's clock."""

from collections.abc import Callable
from typing import Generic, TypeVar

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.intake import Drop

Values = TypeVar("Values")


class Arrivals(Generic[Values]):
    """Puts what carries no time on the Imu's clock, where a few milliseconds do not matter.

    It counts from when it arrives. Where the Imu's stamps are far from that, as those of an
    autopilot that counts from its start, it counts from just after the Imu's newest sample; what
    came before there was any, from just after the first to be looked at.
    """

    def __init__(
        self,
        identifier: OnlineIdentifier,  # Knows the Imu's stamps
        # Stamp, ns, and values to the identifier; returns why it dropped them, or None
        add: Callable[[int, Values], Drop | None],
        # Told once, in s, how far the arrival of a message is from the Imu's stamps
        say: Callable[[float], None] | None = None,
    ) -> None:
        self._identifier = identifier
        self._jump_ns = round(identifier.settings.time_jump * 1e9)
        self._add = add
        self._say = say
        self._early: tuple[int, Values] | None = None
        self._after_ns = 0
        self._place = 0

    def add(
        self,
        stamp_ns: int | None,  # Its own time, ns; None if it carries none
        arrival_ns: int,  # When it arrived, by the node's clock, ns
        values: Values,  # What `add` takes
    ) -> Drop | None:
        """Take values of a message; return why not, or None."""
        if stamp_ns is not None:
            return self._add(stamp_ns, values)
        newest_ns = self._identifier.intake.newest_ns
        if newest_ns is not None:
            self.settle()
            return self._add(self._stamp(arrival_ns, newest_ns), values)
        drop = self._add(arrival_ns, values)
        if drop is None:
            self._early = arrival_ns, values
        return drop

    def settle(self) -> None:
        """Place what came before the Imu did; to be called before a tick is computed."""
        newest_ns = self._identifier.intake.newest_ns
        if self._early is None or newest_ns is None:
            return
        (arrival_ns, values), self._early = self._early, None
        stamp_ns = self._stamp(arrival_ns, newest_ns)
        if stamp_ns != arrival_ns:  # else it is there already
            self._add(stamp_ns, values)

    def _stamp(self, arrival_ns: int, newest_ns: int) -> int:
        off_ns = arrival_ns - newest_ns
        if abs(off_ns) <= self._jump_ns:
            return arrival_ns
        if self._say is not None:
            self._say(off_ns * 1e-9)
            self._say = None
        # Of several after one sample each has a stamp of its own: the last one counts.
        self._place = self._place + 1 if newest_ns == self._after_ns else 1
        self._after_ns = newest_ns
        return newest_ns + self._place
