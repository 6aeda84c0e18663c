# SPDX-License-Identifier: Apache-2.0
"""Why there is no estimate: what does not arrive, and what arrives and cannot be used.

What the ROS graph says about an input is part of it: who publishes it, as what, and what is meant
instead.
"""

import difflib
import itertools
import os
import time
from collections import Counter, deque
from collections.abc import Iterable

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ARMED, RATES, Drop
from uav_ident_ros.identification.speed import unmeasured
from uav_ident_ros.messages.types import NS_PER_S
from uav_ident_ros.node.inputs import InputMonitor

OWN_OUTPUT = "coefficients_named"
"""Where a node publishes this, its other topics are an identifier's outputs: nobody's inputs."""


def publishers(node: Node, topic: str) -> list[str]:
    """Return the full names of the nodes that publish a topic, once for each publisher."""
    return sorted(_owner(end) for end in node.get_publishers_info_by_topic(topic))


def namesakes(node: Node) -> int:
    """Return how many nodes carry the full name of `node`, itself included."""
    own = (node.get_name(), node.get_namespace())
    return int(node.get_node_names_and_namespaces().count(own))


def why_silent(node: Node, wanted: InputMonitor) -> str:
    """Return why nothing arrives on a topic, and what to do about it."""
    ends = node.get_publishers_info_by_topic(wanted.topic)
    if not ends:
        return f"nobody publishes '{wanted.topic}': {_instead(node, wanted)}"
    fitting = [end for end in ends if end.topic_type == wanted.feed.type_name]
    if not fitting:
        return _other_type(node, wanted, ends[0])
    own = (
        end.qos_profile
        for end in node.get_subscriptions_info_by_topic(wanted.topic)
        if _owner(end) == node.get_fully_qualified_name()
    )
    subscription = next(own, None)
    problems = [_mismatch(end.qos_profile, subscription) for end in fitting]
    if subscription is not None and all(problems):
        policy, offered, requested = next(filter(None, problems))
        return (
            f"'{wanted.topic}' of {_owner(fitting[0])} is {offered}, and "
            f"'qos_overrides.{wanted.topic}.subscription.{policy}' asks for {requested}: set it to "
            f"{offered}"
        )
    return f"'{wanted.topic}' has a publisher, {_owner(fitting[0])}, which sends nothing"


def _other_type(node: Node, wanted: InputMonitor, end: TopicEndpointInfo) -> str:
    """Say that a topic carries another type; which setting, or which topic, would be right."""
    carried = f"'{wanted.topic}' of {_owner(end)} carries {end.topic_type}"
    carries = f"{carried}, but {wanted.feed.type_name} is expected"
    if end.topic_type in wanted.feed.stream.types:
        return f"{carries}: set '{wanted.feed.stream.setting}' to {end.topic_type}"
    return f"{carries}: {_instead(node, wanted)}"


def _mismatch(offered: QoSProfile, requested: QoSProfile | None) -> tuple[str, str, str] | None:
    """Return the policy that keeps a publisher and a subscription apart, offered and asked."""
    if requested is None:
        return None
    best_effort, reliable = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
    if offered.reliability == best_effort and requested.reliability == reliable:
        return "reliability", "best_effort", "reliable"
    volatile, local = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL
    if offered.durability == volatile and requested.durability == local:
        return "durability", "volatile", "transient_local"
    return None


def _instead(node: Node, wanted: InputMonitor) -> str:
    """Say which topic may be meant, or that there is none."""
    found, stream, kind = _published(node), wanted.feed.stream, wanted.feed.type_name
    same = [topic for topic, types in found.items() if kind in types]
    if same:
        best = _nearest(wanted.topic, same)
        return f"'{best}' carries {kind}: start with -r {stream.topic}:={best}"
    able = {topic: types[0] for topic, types in found.items() if types[0] in stream.types}
    if able:
        best = _nearest(wanted.topic, list(able))
        return (
            f"'{best}' carries {able[best]}: start with -r {stream.topic}:={best} "
            f"-p {stream.setting}:={able[best]}"
        )
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    return f"no other topic fits: does its source run, with ROS_DOMAIN_ID {domain}?"


def _published(node: Node) -> dict[str, list[str]]:
    """Return topics that others publish, and their types; without those of any identifier."""
    topics = {name: types for name, types in node.get_topic_names_and_types() if types}
    own = {name.rpartition("/")[0] for name in topics if name.endswith(f"/{OWN_OUTPUT}")}
    return {
        name: types
        for name, types in topics.items()
        if name.rpartition("/")[0] not in own and node.count_publishers(name)
    }


def _nearest(topic: str, names: list[str]) -> str:
    return max(sorted(names), key=lambda name: difflib.SequenceMatcher(a=topic, b=name).ratio())


def _owner(end: TopicEndpointInfo) -> str:
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


# --- what is waited for ---------------------------------------------------------------------------


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

LOOKS = 3
"""Looks, a second apart, between which these are counted."""

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


class Waiting:
    """Looks once a second for what keeps the node from an estimate."""

    def __init__(
        self,
        node: Node,  # Knows the graph
        identifier: OnlineIdentifier,  # Knows the newest stamp
        monitors: Iterable[InputMonitor],  # Counts of the subscriptions
        clock: ClockWatch,  # Knows whether /clock moves
    ) -> None:
        self._node, self._identifier, self._clock = node, identifier, clock
        self._monitors = [m for m in monitors if m.feed.stream.setting]  # others need not come
        self._looks: dict[str, deque[tuple[int, Counter[str]]]] = {
            m.topic: deque(maxlen=LOOKS) for m in self._monitors
        }
        self._began = time.monotonic()
        self._ticks = (0, self._began)
        self._stamp: tuple[int | None, float] = (None, self._began)
        # Whether the stamps of the rates went on until the last look. Where they do not, those of
        # the actuators are soon far from them: that is no fault of the actuators
        self.imu_moves = False

    def reason(
        self,
        ticks: int,  # Ticks computed since the start
    ) -> str:
        """Return what is missed, and what to do; empty if nothing is."""
        now, newest_ns = time.monotonic(), self._identifier.intake.newest_ns
        if ticks != self._ticks[0]:
            self._ticks = (ticks, now)
        self.imu_moves = newest_ns != self._stamp[0]
        if self.imu_moves:
            self._stamp = (newest_ns, now)
        lost = [self._all_dropped(monitor) for monitor in self._monitors]
        if self._node.get_clock().ros_time_is_active and (standing := self._clock.silence()):
            return standing
        silent = (self._silent(monitor) for monitor in self._monitors)
        if found := next(filter(None, itertools.chain(silent, lost)), ""):
            return found
        if ticks and now - self._ticks[1] <= SILENT_AFTER:
            return ""
        early = "no tick is due any more" if ticks else "the first tick is not due yet"
        return self._standing(now) or early

    def _silent(self, monitor: InputMonitor) -> str:
        """Say why no message of a stream arrives; empty if they do."""
        age = monitor.age()
        # Whether it is armed, some say only when it changes.
        if age is not None and (age <= SILENT_AFTER or monitor.feed.stream.name == ARMED):
            return ""
        since = "yet" if age is None else f"for more than {SILENT_AFTER:g} s"
        missed = f"no message on '{monitor.topic}' {since}"
        if time.monotonic() - self._began < DISCOVERY_TIME:
            return missed
        return f"{missed}: {why_silent(self._node, monitor)}"

    def _all_dropped(self, monitor: InputMonitor) -> str:
        """Say why every message of the last seconds was dropped; empty if one was not."""
        drops, looks = monitor.feed.drops(), self._looks[monitor.topic]
        looks.append((monitor.feed.received, drops))
        received_before, drops_before = looks[0]
        received, dropped = monitor.feed.received - received_before, drops - drops_before
        if received < ENOUGH or dropped.total() < received:
            return ""
        reason = dropped.most_common(1)[0][0]
        what = monitor.feed.details.get(reason) or CURES.get(reason) or reason
        return f"every message on '{monitor.topic}' is dropped: {what}"

    def _standing(self, now: float) -> str:
        """Say that the stamps of the rates stand still; empty if they move."""
        newest_ns, since = self._stamp
        # `since` is the time of a look, and so is this: two are about `SILENT_AFTER` apart.
        if newest_ns is None or now - since <= 0.75 * SILENT_AFTER:
            return ""
        rates = next(m for m in self._monitors if m.feed.stream.name == RATES)
        return (
            f"the stamps on '{rates.topic}' stand still at {newest_ns / NS_PER_S:.3f} s: let the "
            "source stamp each message"
        )

    def warnings(self) -> list[str]:
        """Return what does not keep it from learning and is wrong all the same, a line each."""
        lines = [unmeasured(self._identifier.settings)]
        same = namesakes(self._node)
        if same > 1:
            lines.append(
                f"{same} nodes are called '{self._node.get_fully_qualified_name()}': their outputs "
                "mix, and they write the same state file; give each a namespace, -r __ns:=/drone1"
            )
        for monitor in self._monitors:
            names = monitor.publishers = publishers(self._node, monitor.topic)
            if len(names) > 1:
                lines.append(
                    f"'{monitor.topic}' has {len(names)} publishers, whose messages mix: "
                    f"{', '.join(names)}; end one, or remap its topic"
                )
        return [line for line in lines if line]
