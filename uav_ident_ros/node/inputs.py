# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of the node: from a topic to the identifier, and what became of the messages."""

import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import RATES
from uav_ident_ros.messages.feed import Feed
from uav_ident_ros.messages.streams import STREAMS, Stream
from uav_ident_ros.messages.types import ChannelError, RatesReader, import_type
from uav_ident_ros.node.notices import Guard, Throttle, without_sources

LARGEST_INBOX = 200
"""Messages that may wait to be looked at: where the timer stands still, with /clock."""

QUEUE_DEPTH = 500
"""Messages kept while the node is busy: half a second at 1 kHz. A depth of 5 loses some."""

_OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)


class InputMonitor:
    """Watches the subscription to one input."""

    def __init__(self, feed: Feed, topic: str) -> None:
        self.feed, self.topic = feed, topic
        self.publishers: list[str] = []  # Nodes that publish it
        self._last_arrival: float | None = None
        self._rate_from = (time.monotonic(), 0)

    def take(self, data: bytes, arrival_ns: int) -> None:
        """Take a message that arrived at a time by the node's clock, ns."""
        self._last_arrival = time.monotonic()
        self.feed.take(data, arrival_ns)

    def age(self) -> float | None:
        """Seconds since the last message arrived; None before the first."""
        return None if self._last_arrival is None else time.monotonic() - self._last_arrival

    def values(self) -> Iterator[tuple[str, str]]:
        """Yield what is to be shown, each with its label; the rate is that since the last time."""
        (since, count), now = self._rate_from, time.monotonic()
        received = self.feed.received
        self._rate_from = (now, received)
        drops, age = self.feed.drops(), self.age()
        yield "topic", self.topic
        yield "type", self.feed.type_name
        yield "publishers", ", ".join(self.publishers) or "none"
        yield "messages", str(received)
        yield "rate [Hz]", f"{(received - count) / max(now - since, 1e-3):.1f}"
        yield "age [s]", "no message yet" if age is None else f"{age:.2f}"
        yield "dropped", str(drops.total())
        for reason, n in sorted(drops.items()):
            yield f"dropped: {reason}", str(n)


class Inputs:
    """Subscribes to the streams, to the optional ones only if their type is set.

    Messages wait as bytes, in the order of their arrival, to be looked at many at once: one by one,
    each finds the processor's caches filled with something else, and takes several times as long.
    As bytes, a message that cannot be decoded is refused like any other bad one; decoded by rclpy,
    it would end the node.
    """

    def __init__(
        self,
        node: Node,  # Owner of the subscriptions; its clock stamps messages that carry no time
        identifier: OnlineIdentifier,  # Takes the samples
        warnings: Throttle,  # Takes what was refused, and why
        guard: Guard,  # Takes errors that nobody foresaw
    ) -> None:
        self._node, self._warnings, self._guard = node, warnings, guard
        self._waiting: list[tuple[Callable[[bytes, int], object], bytes, int]] = []
        self.monitors: dict[str, InputMonitor] = {}  # Of each stream that is read
        for stream in STREAMS:
            if stream.type_of(identifier.settings):
                self.monitors[stream.name] = self._subscribe(stream, identifier)

    @property
    def rates(self) -> RatesReader:
        """What reads the rates: it knows their frame."""
        reader: RatesReader = self.monitors[RATES].feed.reader
        return reader

    def empty(self) -> None:
        """Hand out all messages that wait."""
        waiting, self._waiting = self._waiting, []
        for take, data, arrival_ns in waiting:
            take(data, arrival_ns)

    def settle(self) -> None:
        """Place what came before the Imu did; to be called before a tick is computed."""
        for monitor in self.monitors.values():
            monitor.feed.settle()

    def _subscribe(self, stream: Stream, identifier: OnlineIdentifier) -> InputMonitor:
        clock, timed = self._node.get_clock(), stream.name != RATES
        topic = self._node.resolve_topic_name(stream.topic)
        kind = import_type(stream.type_of(identifier.settings))

        def decode(data: bytes) -> Any:
            try:
                return deserialize_message(data, kind)
            except (RuntimeError, UnicodeDecodeError) as error:
                words = f"it cannot be decoded ({without_sources(str(error))})"
                raise ChannelError(words, "not decodable") from None

        def warn(reason: str, words: str) -> None:
            self._warnings.notice((topic, reason), lambda: f"'{topic}': message dropped: {words}")

        def log_offset(seconds: float) -> None:
            self._node.get_logger().info(
                f"'{topic}': its messages carry no time and arrive {seconds:+.1f} s from the Imu's "
                "stamps: each counts from the newest of them"
            )

        def put(data: bytes) -> None:
            self._waiting.append((take, data, clock.now().nanoseconds if timed else 0))
            if len(self._waiting) >= LARGEST_INBOX:
                self.empty()

        monitor = InputMonitor(Feed(stream, identifier, decode, warn, log_offset), topic)
        take = self._guard(monitor.take)
        self._node.create_subscription(
            kind,
            stream.topic,
            put,
            QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT),
            qos_overriding_options=QoSOverridingOptions(_OVERRIDABLE),
            raw=True,
        )
        return monitor
