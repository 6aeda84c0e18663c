# SPDX-License-Identifier: Apache-2.0
"""The node's subscriptions: messages to samples of the identifier, and what is refused."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.intake import RATES, Drop
from uav_ident_ros.messages.arrival import Arrivals
from uav_ident_ros.messages.imu import IMU_TYPE, decode_imu_cdr
from uav_ident_ros.messages.streams import STREAMS, Stream
from uav_ident_ros.messages.types import ChannelError, RatesReader, Reading, import_type
from uav_ident_ros.node.diagnostics import InputMonitor
from uav_ident_ros.node.notices import Guard, Throttle, without_sources

LARGEST_INBOX = 200
"""Messages that may wait to be looked at: where the timer stands still, with /clock."""

QUEUE_DEPTH = 500
"""Messages kept while the node is busy: half a second at 1 kHz. A depth of 5 loses some."""

LARGEST_MESSAGE = 65_536
"""Bytes of a message beyond which it is none of these: an Imu takes 350, a hundred named channels
4000. Its names or its frame would fill the log and /diagnostics, and take a second to read."""

_OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)


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
        self._node, self._identifier, self._warnings = node, identifier, warnings
        self._waiting: list[tuple[Callable[[bytes, int], object], bytes, int]] = []
        self._arrivals: list[Arrivals[Any]] = []
        self.monitors: dict[str, InputMonitor] = {}  # Counts, by stream
        self.rates = RatesReader(identifier.settings.imu)  # Knows the frame of the rates
        for stream in STREAMS:
            if type_name := stream.type_of(identifier.settings):
                self._subscribe(stream, type_name, guard)

    def empty(self) -> None:
        """Hand out all messages that wait."""
        waiting, self._waiting = self._waiting, []
        for take, data, arrival_ns in waiting:
            take(data, arrival_ns)

    def settle(self) -> None:
        """Place what came before the Imu did; to be called before a tick is computed."""
        for arrivals in self._arrivals:
            arrivals.settle()

    def _subscribe(self, stream: Stream, type_name: str, guard: Guard) -> None:
        read, add = self._reader(stream, import_type(type_name)), self._adder(stream)
        clock, timed = self._node.get_clock(), stream.name != RATES

        def take(data: bytes, arrival_ns: int) -> None:
            monitor.arrived()
            try:
                drop = add(*read(data), arrival_ns)
            except ChannelError as error:
                monitor.refuse(error.reason, str(error))
                self._warn(monitor, error.reason, str(error))
                return
            if drop is not None:
                self._warn(monitor, drop.value, drop.value)

        def put(data: bytes) -> None:
            self._waiting.append((guarded, data, clock.now().nanoseconds if timed else 0))
            if len(self._waiting) >= LARGEST_INBOX:
                self.empty()

        guarded = guard(take)
        subscription = self._node.create_subscription(
            import_type(type_name),
            stream.topic,
            put,
            QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT),
            qos_overriding_options=QoSOverridingOptions(_OVERRIDABLE),
            raw=True,
        )
        monitor = self.monitors[stream.name] = InputMonitor(subscription.topic_name, type_name)

    def _reader(self, stream: Stream, kind: type) -> Callable[[bytes], Reading]:
        """Return what reads the bytes of a stream's messages; it may raise `ChannelError`."""
        settings = self._identifier.settings
        read = self.rates if stream.name == RATES else stream.reader(settings)

        def decoded(data: bytes) -> Reading:
            if len(data) > LARGEST_MESSAGE:
                name = stream.type_of(settings)
                raise ChannelError(f"it takes {len(data)} bytes: is it {name} at all?", "too large")
            try:
                message = deserialize_message(data, kind)
            except (RuntimeError, UnicodeDecodeError) as error:
                said = f"it cannot be decoded ({without_sources(str(error))})"
                raise ChannelError(said, "not decodable") from None
            return read(message)

        def decoded_imu(data: bytes) -> Reading:
            # Decoding an Imu here costs a fraction of making a message object of it.
            reading = decode_imu_cdr(data) if len(data) <= LARGEST_MESSAGE else None
            return decoded(data) if reading is None else self.rates.checked(reading)

        return decoded_imu if stream.type_of(settings) == IMU_TYPE else decoded

    def _adder(self, stream: Stream) -> Callable[[int | None, Any, int], Drop | None]:
        """Return what takes stamp, values and time of arrival; returns why it did not, or None."""

        def add(stamp_ns: int, values: Any) -> Drop | None:
            return stream.add(self._identifier, stamp_ns, values)

        def on_arrival(stamp_ns: int | None, values: Any, arrival_ns: int) -> Drop | None:
            return add(arrival_ns if stamp_ns is None else stamp_ns, values)

        if not stream.any_clock:
            return on_arrival
        topic = self._node.resolve_topic_name(stream.topic)

        def say(seconds: float) -> None:
            self._node.get_logger().info(
                f"'{topic}': its messages carry no time and arrive {seconds:+.1f} s from the Imu's "
                "stamps: each counts from the newest of them"
            )

        self._arrivals.append(arrivals := Arrivals(self._identifier, add, say))
        return lambda stamp_ns, values, arrival_ns: arrivals.add(stamp_ns, arrival_ns, values)

    def _warn(self, monitor: InputMonitor, reason: str, detail: str) -> None:
        topic = monitor.topic
        self._warnings.notice((topic, reason), lambda: f"'{topic}': message dropped: {detail}")
