# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of the node: from a topic to the identifier, with counts of used messages."""

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import RATES_STREAM
from uav_ident_ros.messages.feed import Feed
from uav_ident_ros.messages.streams import STREAMS, Stream
from uav_ident_ros.messages.types import NOT_DECODABLE, ChannelError, RatesReader, import_type
from uav_ident_ros.node.notices import Guard, Throttle, without_sources
from uav_ident_ros.node.parameters import QOS_POLICIES

LARGEST_INBOX = 200
"""Messages that may wait for the timer, which stands still if /clock does."""

QUEUE_DEPTH = 500
"""Depth of the queue: half a second at 1 kHz. With a depth of 5 messages are lost."""

_OVERRIDABLE = tuple(QoSPolicyKind[name.upper()] for name in QOS_POLICIES)


class Input:
    """One input: its topic, its publishers, and the use of its messages."""

    subscription: Subscription

    def __init__(
        self, node: Node, stream: Stream, identifier: OnlineIdentifier, warnings: Throttle
    ) -> None:
        self.stream = stream
        self.topic = node.resolve_topic_name(stream.topic)
        self.qos = QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.publishers: list[str] = []  # Nodes that publish the topic
        self.arrived: float | None = None  # Arrival of the last message by the steady clock, s
        self.kind = import_type(stream.type_of(identifier.settings))
        self.feed = Feed(stream, identifier, self._decode, self._warn, self._log_offset)
        self._log, self._warnings = node.get_logger(), warnings
        self._rate_from = (time.monotonic(), 0)

    def _decode(self, data: bytes) -> Any:
        try:
            return deserialize_message(data, self.kind)
        except (RuntimeError, UnicodeDecodeError) as error:
            problem = f"it cannot be decoded ({without_sources(str(error))})"
            raise ChannelError(problem, NOT_DECODABLE) from None

    def _warn(self, reason: str, problem: str) -> None:
        self._warnings.notice((self.topic, reason), f"'{self.topic}': message dropped: {problem}")

    def _log_offset(self, seconds: float) -> None:
        self._log.info(
            f"'{self.topic}': its messages carry no time and arrive {seconds:+.1f} s from the "
            "Imu's stamps: each counts from the newest of them"
        )

    def age(self) -> float | None:
        """Return the time since the last message arrived, s; None before the first."""
        return None if self.arrived is None else time.monotonic() - self.arrived

    def values(self) -> Iterator[tuple[str, str]]:
        """Yield the values for /diagnostics, with labels; the rate is that since the last call."""
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
    """Subscribes to the streams; to optional ones only if their type is set.

    Messages wait as bytes, in the order of arrival, and are processed many at a time. One at a
    time takes several times as long, since the processor's caches are cold. As bytes, a message
    that cannot be decoded is dropped; decoded by rclpy, it would end the node.
    """

    def __init__(
        self, node: Node, identifier: OnlineIdentifier, warnings: Throttle, guard: Guard
    ) -> None:
        self._clock, self._guard = node.get_clock(), guard
        self._waiting: list[tuple[Input, bytes, int]] = []
        self.all: dict[str, Input] = {}  # Subscribed inputs, by the stream's name
        for stream in STREAMS:
            if not stream.type_of(identifier.settings):
                continue
            own = self.all[stream.name] = Input(node, stream, identifier, warnings)
            own.subscription = node.create_subscription(
                own.kind,
                stream.topic,
                partial(self._put, own),
                own.qos,  # rclpy writes overrides into it
                qos_overriding_options=QoSOverridingOptions(_OVERRIDABLE),
                raw=True,
            )

    @property
    def rates(self) -> RatesReader:
        """Reader of the rates, with their frame."""
        reader: RatesReader = self.all[RATES_STREAM].feed.reader
        return reader

    def _put(self, own: Input, data: bytes) -> None:
        own.arrived = time.monotonic()
        # rates have stamps of their own
        arrival_ns = 0 if own.stream.name == RATES_STREAM else self._clock.now().nanoseconds
        self._waiting.append((own, data, arrival_ns))
        if len(self._waiting) >= LARGEST_INBOX:
            self.empty()

    def empty(self) -> None:
        """Process all waiting messages."""
        waiting, self._waiting = self._waiting, []
        for own, data, arrival_ns in waiting:
            try:  # at a fraction of the time of a context manager
                own.feed.take(data, arrival_ns)
            except Exception as error:
                self._guard.note("take", error)
        for own in self.all.values():
            own.feed.settle()
