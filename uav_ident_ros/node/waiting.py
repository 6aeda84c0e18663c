# SPDX-License-Identifier: Apache-2.0
"""Why there is no estimate: what does not arrive, and what arrives and cannot be used."""

import time
from collections import Counter
from collections.abc import Mapping

from rclpy.node import Node

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.intake import ARMED, RATES, Drop
from uav_ident_ros.identification.speed import unmeasured
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.messages.types import NS_PER_S
from uav_ident_ros.node.diagnostics import InputMonitor
from uav_ident_ros.node.graph import Wanted, namesakes, publishers, why_silent

STANDS_AFTER = 2.0
"""Seconds without progress of /clock that are worth a word."""

STEPS = 3
"""Jumps in a row that are no accident but how /clock moves."""


class ClockWatch:
    """Watches the node's clock under simulated time."""

    def __init__(
        self,
        time_jump: float,  # Step of /clock from which on it counts as a jump, s
        # Ticks per second: jumps in a row have less than a second of ticks between them
        update_rate: float,
    ) -> None:
        self._time_jump = time_jump
        self._few_ticks = update_rate
        self._now_ns = 0
        self._moved = time.monotonic()
        self._jumps = 0
        self._step = 0.0
        self._ticks = 0

    def look(self, now_ns: int) -> None:
        """Note where the clock is; to be called about once a second."""
        if now_ns != self._now_ns:
            self._now_ns, self._moved = now_ns, time.monotonic()

    def jumped(self, seconds: float, ticks: int) -> None:
        """Note a jump by `seconds` after so many ticks since the start."""
        in_row = seconds > 0.0 and ticks - self._ticks < self._few_ticks
        self._jumps = self._jumps + 1 if in_row else 1
        self._step, self._ticks = seconds, ticks

    def fault(self, ticks: int) -> str:
        """Return why the filters restart for ever; empty if they do not."""
        if self._jumps < STEPS or ticks - self._ticks >= self._few_ticks:
            return ""
        return (
            f"/clock moves in steps of {self._step:.3g} s, and each of 'time_jump' "
            f"({self._time_jump:g} s) or more restarts the filters: publish it more often "
            "(ros2 bag play --clock 100)"
        )

    def silence(self) -> str:
        """Return what is wrong with /clock if it stands still; empty if it moves."""
        if time.monotonic() - self._moved <= STANDS_AFTER:
            return ""
        if self._now_ns == 0:
            return (
                "use_sim_time is true, but nothing arrives on /clock: play the bag with --clock, "
                "or set use_sim_time to false"
            )
        return "/clock stands still"


SILENT_AFTER = 2.0
"""Seconds without a message, or a tick, that are worth a word."""

DISCOVERY_TIME = 1.5
"""Seconds from the start in which the graph is not complete yet."""

ENOUGH = 5
"""Messages that must be dropped, and none taken, before it is said of all of them."""

CURES: dict[str, str] = {
    Drop.NOT_FINITE: "their values are not finite numbers: look at the source",
    Drop.ZERO_STAMP: "their stamp is zero: let the source stamp them",
    Drop.BEYOND_STAMP: "their stamp is beyond 2038: look at the clock of the source",
    Drop.OUTLYING_STAMP: "their stamps jump to and fro: are there two sources?",
    Drop.IMPLAUSIBLE: "their values are larger than any aircraft has: look at units and type",
    Drop.LATE: "they come late: raise 'input_wait', or synchronise the clocks",
    Drop.DUPLICATE: "their stamps repeat: let the source stamp each",
}
"""What to do about messages that are all dropped for one reason, where what read them says nothing
of its own."""

_AWAITED = {stream.name: stream for stream in STREAMS if stream.setting}
"""The streams that are waited for."""


class Waiting:
    """Looks once a second for what keeps the node from an estimate."""

    def __init__(
        self,
        node: Node,  # Knows the graph
        identifier: OnlineIdentifier,  # Knows the drops, and the newest stamp
        monitors: Mapping[str, InputMonitor],  # Counts of the subscriptions, by stream
        clock: ClockWatch,  # Knows whether /clock moves
    ) -> None:
        self._node = node
        self._identifier = identifier
        self._clock = clock
        self._monitors = {s: monitor for s, monitor in monitors.items() if s in _AWAITED}
        self._before: dict[str, list[tuple[int, Counter[str]]]] = {s: [] for s in self._monitors}
        self._ticks = (0, time.monotonic())
        self._stamp: tuple[int | None, float] = (None, time.monotonic())
        self._began = time.monotonic()
        # Whether the stamps of the rates went on until the last look. Where they do not, those of
        # the actuators are soon far from them: that is no fault of the actuators
        self.imu_moves = False
        self._lost = dict.fromkeys(self._monitors, "")

    def reason(
        self,
        ticks: int,  # Ticks computed since the start
    ) -> str:
        """Return what is missed, and what to do; empty if nothing is."""
        now = time.monotonic()
        if ticks != self._ticks[0]:
            self._ticks = (ticks, now)
        self.imu_moves = self._identifier.intake.newest_ns != self._stamp[0]
        if self.imu_moves:
            self._stamp = (self._identifier.intake.newest_ns, now)
        self._lost = {stream: self._all_dropped(stream) for stream in self._monitors}
        if self._node.get_clock().ros_time_is_active and (standing := self._clock.silence()):
            return standing
        for stream, monitor in self._monitors.items():
            if silent := self._silent(stream, monitor):
                return silent
        if lost := next(filter(None, self._lost.values()), ""):
            return lost
        if ticks and now - self._ticks[1] <= SILENT_AFTER:
            return ""
        return self._standing() or self._early(ticks)

    def _silent(self, stream: str, monitor: InputMonitor) -> str:
        """Say why no message of a stream arrives; empty if they do."""
        age = monitor.age()
        # Whether it is armed, some say only when it changes.
        if age is not None and (age <= SILENT_AFTER or stream == ARMED):
            return ""
        missed = (
            f"no message on '{monitor.topic}' yet"
            if age is None
            else f"no message on '{monitor.topic}' for more than {SILENT_AFTER:g} s"
        )
        if time.monotonic() - self._began < DISCOVERY_TIME:
            return missed
        row = _AWAITED[stream]
        wanted = Wanted(row.topic, monitor.topic, monitor.type_name, row.setting, row.types)
        return f"{missed}: {why_silent(self._node, wanted)}"

    def _all_dropped(self, stream: str) -> str:
        """Say why every message of the last seconds was dropped; empty if one was not."""
        monitor = self._monitors[stream]
        drops = monitor.drops(self._identifier.intake.drops[stream])
        history = self._before[stream]
        history.append((monitor.received, drops))
        if len(history) > 3:
            history.pop(0)
        received = monitor.received - history[0][0]
        dropped = drops - history[0][1]
        if received < ENOUGH or dropped.total() < received:
            return ""
        reason = dropped.most_common(1)[0][0]
        what = monitor.details.get(reason) or CURES.get(reason) or reason
        return f"every message on '{monitor.topic}' is dropped: {what}"

    def _standing(self) -> str:
        """Say that the stamps of the rates stand still; empty if they move."""
        newest_ns, since = self._stamp
        monitor = self._monitors[RATES]
        age = monitor.age()
        if newest_ns is None or age is None or age > SILENT_AFTER or self._lost[RATES]:
            return ""
        # `since` is the time of a look, and so is this: two are about `SILENT_AFTER` apart.
        if time.monotonic() - since <= 0.75 * SILENT_AFTER:
            return ""
        topic = monitor.topic
        return (
            f"the stamps on '{topic}' stand still at {newest_ns / NS_PER_S:.3f} s: let the source "
            "stamp each message"
        )

    @staticmethod
    def _early(ticks: int) -> str:
        return "no tick is due any more" if ticks else "the first tick is not due yet"

    def warnings(self) -> list[str]:
        """Return what does not keep it from learning and is wrong all the same, a line each."""
        lines = [unmeasured(self._identifier.settings)]
        same = namesakes(self._node)
        if same > 1:
            lines.append(
                f"{same} nodes are called '{self._node.get_fully_qualified_name()}': their outputs "
                "mix, and they write the same state file; give each a namespace, -r __ns:=/drone1"
            )
        for monitor in self._monitors.values():
            names = monitor.publishers = publishers(self._node, monitor.topic)
            if len(names) > 1:
                lines.append(
                    f"'{monitor.topic}' has {len(names)} publishers, whose messages mix: "
                    f"{', '.join(names)}; end one, or remap its topic"
                )
        return [line for line in lines if line]
