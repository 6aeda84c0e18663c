# SPDX-License-Identifier: Apache-2.0
"""Reasons for missing estimates: inputs that do not arrive, and inputs that cannot be used.

The ROS graph gives the publishers of an input, their types and QoS, and alternative topics.
"""

import difflib
import itertools
import time
from collections import Counter, deque
from collections.abc import Iterable

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ARMED, Drop
from uav_ident_ros.identification.speed import unmeasured
from uav_ident_ros.messages.published import NAMED
from uav_ident_ros.messages.streams import EXCITATION_END
from uav_ident_ros.node.inputs import Input
from uav_ident_ros.ros import domain

INCOMPATIBLE_QOS: dict[str, tuple[ReliabilityPolicy | DurabilityPolicy, ...]] = {
    "reliability": (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE),
    "durability": (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL),
}
"""Incompatible QoS, by policy: offered by a publisher, and requested by a subscription."""


def silence_reason(node: Node, wanted: Input) -> str:
    """Return the reason why nothing arrives on a topic, and the cure."""
    ends, kind = node.get_publishers_info_by_topic(wanted.topic), wanted.feed.type_name
    if not ends:
        return f"nobody publishes '{wanted.topic}': {_alternative_topic(node, wanted)}"
    fitting = [end for end in ends if end.topic_type == kind]
    if not fitting:
        other, stream = ends[0].topic_type, wanted.stream
        cure = f"set '{stream.setting}' to {other}" if other in stream.types else ""
        return (
            f"'{wanted.topic}' of {_owner(ends[0])} carries {other}, but {kind} is expected: "
            f"{cure or _alternative_topic(node, wanted)}"
        )
    problems = [_mismatch(end.qos_profile, wanted) for end in fitting]
    if all(problems):
        return f"'{wanted.topic}' of {_owner(fitting[0])} is {problems[0]}"
    return f"'{wanted.topic}' has a publisher, {_owner(fitting[0])}, which sends nothing"


def _mismatch(offered: QoSProfile, wanted: Input) -> str:
    """Return the incompatible QoS policy of a publisher and a subscription; empty if none."""
    for policy, (less, more) in INCOMPATIBLE_QOS.items():
        if getattr(offered, policy) == less and getattr(wanted.qos, policy) == more:
            name = less.name.lower()
            return (
                f"{name}, and 'qos_overrides.{wanted.topic}.subscription.{policy}' asks for "
                f"{more.name.lower()}: set it to {name}"
            )
    return ""


def _alternative_topic(node: Node, wanted: Input) -> str:
    """Return advice on a topic that may be meant, in the node's namespace if one fits there."""
    found, stream, own = _published(node), wanted.stream, wanted.feed.type_name
    space = node.get_namespace().rstrip("/")
    here = {topic: types for topic, types in found.items() if topic.startswith(f"{space}/")}
    for topics, kinds in itertools.product((here, found), ((own,), stream.types)):
        fitting = {t: kind for t, types in topics.items() for kind in types if kind in kinds}
        if fitting:
            (best,) = difflib.get_close_matches(wanted.topic, fitting, n=1, cutoff=0.0)
            kind = fitting[best]
            typed = "" if kind == own else f" -p {stream.setting}:={kind}"
            return f"'{best}' carries {kind}: start with -r {stream.topic}:={best}{typed}"
    return f"no other topic fits; does its source run, {domain()}?"


def _published(node: Node) -> dict[str, list[str]]:
    """Return all published topics with their types, without identifiers' and injected signals."""
    topics = dict(node.get_topic_names_and_types())
    own = {name.rpartition("/")[0] for name in topics if name.endswith(f"/{NAMED}")}
    return {
        name: types
        for name, types in topics.items()
        if name.rpartition("/")[0] not in own
        and not name.endswith(EXCITATION_END)
        and node.count_publishers(name)
    }


def _owner(end: TopicEndpointInfo) -> str:
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


# --- missing inputs -------------------------------------------------------------------------------


class Progress:
    """Timer since the last change of a value."""

    def __init__(self, first: int | None) -> None:
        self._last, self._since = first, time.monotonic()

    def unchanged_for(self, value: int | None) -> float:
        """Return the time since the value changed, s; 0 if it differs from the last one."""
        now = time.monotonic()
        if value != self._last:
            self._last, self._since = value, now
        return now - self._since


SILENT_AFTER = 2.0
"""Seconds without a message, a tick, or progress of /clock, that are reported."""

DISCOVERY_TIME = 1.5
"""Seconds from the start in which the graph is incomplete."""

FEWEST_DROPPED = 5
"""Least number of messages, all dropped, that is reported."""

LOOKS = 3
"""Checks, a second apart, over which these messages are counted."""

DROP_CURES: dict[str, str] = {
    Drop.NOT_FINITE: "their values are not finite numbers: look at the source",
    Drop.ZERO_STAMP: "their stamp is zero or negative: let the source stamp them",
    Drop.BEYOND_STAMP: "their stamp is beyond 2038: look at the clock of the source",
    Drop.OUTLYING_STAMP: "their stamps jump to and fro: are there two sources?",
    Drop.IMPLAUSIBLE: "their values are larger than any aircraft has: look at units and type",
    Drop.LATE: "they come late: raise 'input_wait', or synchronise the clocks",
    Drop.DUPLICATE: "their stamps repeat: let the source stamp each",
}
"""Cures for messages that are all dropped for one reason, if their reader gives none."""


class Waiting:
    """Determines, once a second, the reason for missing estimates."""

    def __init__(self, node: Node, identifier: OnlineIdentifier, inputs: Iterable[Input]) -> None:
        self._node, self._identifier = node, identifier
        self._all = list(inputs)
        self._inputs = [own for own in self._all if own.stream.setting]  # others are optional
        self._looks: dict[str, deque[tuple[int, Counter[str]]]] = {
            own.topic: deque(maxlen=LOOKS) for own in self._inputs
        }
        self._began = time.monotonic()
        self._clock, self._ticks, self._stamp = Progress(0), Progress(0), Progress(None)
        # Whether the stamps of the rates advanced before the last check. If not, the stamps of the
        # actuators soon differ from them, without a fault of the actuators
        self.imu_moves = False

    def reason(self, ticks: int) -> str:
        """Return the missing input and the cure, given the number of ticks; empty if none."""
        ticks_unchanged_for = self._ticks.unchanged_for(ticks)
        self.imu_moves = self._stamp.unchanged_for(self._identifier.intake.newest_ns) == 0.0
        lost = [self._all_dropped(own) for own in self._inputs]
        if found := self._clock_problem():
            return found
        silent = map(self._silence_problem, self._inputs)
        if found := next(filter(None, itertools.chain(silent, lost)), ""):
            return found
        if ticks and ticks_unchanged_for <= SILENT_AFTER:
            return ""
        return "no tick is due any more" if ticks else "the first tick is not due yet"

    def _clock_problem(self) -> str:
        """Return the problem of a /clock that stands still; empty if it advances or is unused."""
        clock = self._node.get_clock()
        now_ns = clock.now().nanoseconds
        if self._clock.unchanged_for(now_ns) <= SILENT_AFTER or not clock.ros_time_is_active:
            return ""
        if now_ns == 0:
            return (
                "use_sim_time is true, but nothing arrives on /clock: play the bag with --clock, "
                "or set use_sim_time to false"
            )
        return "/clock stands still"

    def _silence_problem(self, own: Input) -> str:
        """Return the reason why no message of an input arrives; empty if they do."""
        age = own.age()
        # Some autopilots publish the armed state only when it changes.
        if age is not None and (age <= SILENT_AFTER or own.stream.name == ARMED):
            return ""
        since = "yet" if age is None else f"for more than {SILENT_AFTER:g} s"
        missing = f"no message on '{own.topic}' {since}"
        if time.monotonic() - self._began < DISCOVERY_TIME:
            return missing
        return f"{missing}: {silence_reason(self._node, own)}"

    def _all_dropped(self, own: Input) -> str:
        """Return the reason why all messages of the last seconds were dropped; empty if not all."""
        now, looks = (own.feed.received, own.feed.drops()), self._looks[own.topic]
        looks.append(now)
        received, dropped = now[0] - looks[0][0], now[1] - looks[0][1]
        if received < FEWEST_DROPPED or dropped.total() < received:
            return ""
        reason = dropped.most_common(1)[0][0]
        what = own.feed.details.get(reason) or DROP_CURES.get(reason) or reason
        return f"every message on '{own.topic}' is dropped: {what}"

    def warnings(self) -> list[str]:
        """Return the problems that do not prevent learning, a line each."""
        node = self._node
        lines = [unmeasured(self._identifier.settings)]
        named = node.get_node_names_and_namespaces()
        same = named.count((node.get_name(), node.get_namespace()))
        if same > 1:
            lines.append(
                f"{same} nodes are called '{node.get_fully_qualified_name()}': their outputs mix, "
                "and they write the same state file; give each a namespace, -r __ns:=/drone1"
            )
        for own in self._all:
            own.publishers = sorted(map(_owner, node.get_publishers_info_by_topic(own.topic)))
            if len(own.publishers) > 1:
                lines.append(
                    f"'{own.topic}' has {len(own.publishers)} publishers, whose messages mix: "
                    f"{', '.join(own.publishers)}; end one, or remap its topic"
                )
        return [line for line in lines if line]
