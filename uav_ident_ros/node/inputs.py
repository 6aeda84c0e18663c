# SPDX-License-Identifier: Apache-2.0
"""The node's subscriptions: messages to samples of the identifier, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message

from uav_ident_ros.identification.drops import Drop
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.messages.airspeed import AIRSPEED
from uav_ident_ros.messages.armed import ARMED
from uav_ident_ros.messages.arrival import Arrivals
from uav_ident_ros.messages.cdr import ChannelsDecoder
from uav_ident_ros.messages.excitation import EXCITATION_TYPE, read_excitation
from uav_ident_ros.messages.types import (
    RATES,
    ActuatorReader,
    ChannelError,
    RatesReading,
    decode_imu_cdr,
    frame_fault,
    import_type,
)
from uav_ident_ros.node.diagnostics import InputMonitor
from uav_ident_ros.node.guard import Guard
from uav_ident_ros.node.notices import Throttle, without_sources

RATES_TOPIC = "imu/data"
ACTUATORS_TOPIC = "actuators"
AIRSPEED_TOPIC = "airspeed"
ARMED_TOPIC = "armed"
EXCITATION_TOPIC = "excitation"

IMU_TYPE = "sensor_msgs/msg/Imu"

LARGEST_INBOX = 200
"""Messages that may wait to be looked at: where the timer stands still, with /clock."""

QUEUE_DEPTH = 500
"""Messages kept while the node is busy: half a second at 1 kHz. A depth of 5 loses some."""

LARGEST_MESSAGE = 65_536
"""Bytes of a message beyond which it is none of these: an Imu takes 350, a hundred named channels
4000. Its names or its frame would fill the log and /diagnostics, and take a second to read."""

Reading = tuple[int | None, Any]
"""Stamp, ns, None if the message has none, and values."""

_OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)


class Inbox:
    """Keeps messages in the order of their arrival, to be looked at many at once.

    Looked at one by one, each finds the processor's caches filled with something else, and
    takes several times as long.
    """

    def __init__(self) -> None:
        self._waiting: list[tuple[Callable[[bytes, int], object], bytes, int]] = []

    def put(self, take: Callable[[bytes, int], object], data: bytes, arrival_ns: int) -> None:
        """Keep a message for `take`, and when it arrived, ns."""
        self._waiting.append((take, data, arrival_ns))
        if len(self._waiting) >= LARGEST_INBOX:
            self.empty()

    def empty(self) -> None:
        """Hand out all messages."""
        waiting, self._waiting = self._waiting, []
        for take, data, arrival_ns in waiting:
            take(data, arrival_ns)


@dataclass(frozen=True)
class Wiring:
    """What every input is connected to.

    Parameters
    ----------
    node : Node
        Owner of the subscriptions; its clock stamps messages that carry no time.
    identifier : OnlineIdentifier
        Takes the samples.
    inbox : Inbox
        Keeps the messages until the node looks at them.
    warnings : Throttle
        Takes what was refused, and why.
    guard : Guard
        Takes errors that nobody foresaw.
    """

    node: Node
    identifier: OnlineIdentifier
    inbox: Inbox
    warnings: Throttle
    guard: Guard


class _Input:
    """What all inputs share: a subscription to bytes, counts, and what is said about a drop.

    Messages come as bytes, so that one that cannot be decoded is refused like any other bad
    message; decoded by rclpy, it would end the node.

    Parameters
    ----------
    wiring : Wiring
        What it is connected to.
    type_name, topic : str
        Message type and topic.
    take : callable
        Takes the bytes of a message and when it arrived, ns.
    timed : bool
        Whether the time of arrival is wanted; 0 if not.
    """

    def __init__(
        self,
        wiring: Wiring,
        type_name: str,
        topic: str,
        take: Callable[[bytes, int], None],
        *,
        timed: bool,
    ) -> None:
        self._class = import_type(type_name)
        self._warnings = wiring.warnings
        inbox, clock, guarded = wiring.inbox, wiring.node.get_clock(), wiring.guard(take)

        def put(data: bytes) -> None:
            if len(data) > LARGEST_MESSAGE:
                self.monitor.arrived()
                self.refuse("too large", f"it takes {len(data)} bytes: is it {type_name} at all?")
                return
            inbox.put(guarded, data, clock.now().nanoseconds if timed else 0)

        subscription = wiring.node.create_subscription(
            self._class,
            topic,
            put,
            QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT),
            qos_overriding_options=QoSOverridingOptions(_OVERRIDABLE),
            raw=True,
        )
        self.monitor = InputMonitor(subscription.topic_name, type_name)

    def decode(self, data: bytes) -> Any | None:
        """Return the message, or None, and say so, if the bytes are not one."""
        try:
            return deserialize_message(data, self._class)
        except (RuntimeError, UnicodeDecodeError) as error:
            self.refuse("not decodable", f"it cannot be decoded ({without_sources(str(error))})")
            return None

    def refuse(self, reason: str, detail: str) -> None:
        """Count a message that never reaches the identifier, and say why."""
        self.monitor.refused[reason] += 1
        self.monitor.detail = detail
        self.warn(reason, detail)

    def warn(self, reason: str, detail: str) -> None:
        """Say why a message was dropped, unless that was said just now."""
        topic = self.monitor.topic
        self._warnings.notice((topic, reason), lambda: f"'{topic}': message dropped: {detail}")


class RatesInput:
    """Subscription to the rates.

    Parameters
    ----------
    wiring : Wiring
        What it is connected to.

    Attributes
    ----------
    fault : str
        How the messages contradict the parameters; empty if they do not.
    frame_id : str
        Frame of the newest message.
    """

    def __init__(self, wiring: Wiring) -> None:
        self._identifier = wiring.identifier
        self._settings = wiring.identifier.settings.imu
        self._read = RATES[self._settings.type].read
        self._fast = self._settings.type == IMU_TYPE
        self.fault = frame_fault(self._settings.convention, "", self._settings.type)
        self.frame_id = ""
        self._input = _Input(wiring, self._settings.type, RATES_TOPIC, self._take, timed=False)
        self.monitor = self._input.monitor

    def _take(self, data: bytes, _: int) -> None:
        self.monitor.arrived()
        # Decoding an Imu here costs a fraction of making a message object of it.
        reading = decode_imu_cdr(data) if self._fast else None
        if reading is None:
            message = self._input.decode(data)
            if message is None:
                return
            reading = self._read(message)
        self._take_reading(reading)

    def _take_reading(self, reading: RatesReading) -> None:
        if reading.frame_id != self.frame_id:
            self.frame_id = reading.frame_id
            self.fault = frame_fault(
                self._settings.convention, reading.frame_id, self._settings.type
            )
        if self.fault:
            self._input.refuse("wrong frame", self.fault)
        elif reading.rates is None:
            self._input.refuse("no rates", "angular_velocity_covariance[0] is -1: no rates in it")
        else:
            drop = self._identifier.add_rates(
                reading.stamp_ns, reading.rates, reading.specific_force
            )
            if drop is not None:
                self._input.warn(drop.value, drop.value)


class ArrayInput:
    """Subscription to values that may carry no time: those are stamped on arrival.

    Parameters
    ----------
    wiring : Wiring
        What it is connected to.
    type_name, topic : str
        Message type and topic.
    read : callable
        Message to its stamp, ns, or None, and its values; may raise ChannelError.
    add : callable
        Stamp and values to the identifier; returns why it dropped them, or None.
    read_bytes : callable, optional
        The same as `read` from the bytes, without a message; None if they are of another form.
    arrivals : Arrivals, optional
        Takes stamp and values in place of `add`, and knows what to do without a stamp.
    """

    def __init__(
        self,
        wiring: Wiring,
        type_name: str,
        topic: str,
        read: Callable[[Any], Reading],
        add: Callable[[int, Any], Drop | None],
        read_bytes: Callable[[bytes], Reading | None] | None = None,
        arrivals: Arrivals[Any] | None = None,
    ) -> None:
        self._read = read
        self._read_bytes = read_bytes
        self._add = add
        self._arrivals = arrivals
        self._input = _Input(wiring, type_name, topic, self._take, timed=True)
        self.monitor = self._input.monitor

    def settle(self) -> None:
        """Place what came before the Imu did; to be called before a tick is computed."""
        if self._arrivals is not None:
            self._arrivals.settle()

    def _take(self, data: bytes, arrival_ns: int) -> None:
        self.monitor.arrived()
        try:
            reading = self._reading(data)
        except ChannelError as error:
            reason = "not finite" if error.not_finite else "wrong channels"
            self._input.refuse(reason, str(error))
            return
        if reading is None:
            return
        stamp_ns, values = reading
        if self._arrivals is not None:
            drop = self._arrivals.add(stamp_ns, arrival_ns, values)
        else:
            drop = self._add(arrival_ns if stamp_ns is None else stamp_ns, values)
        if drop is not None:
            self._input.warn(drop.value, drop.value)

    def _reading(self, data: bytes) -> Reading | None:
        """Read a message; None, and say so, if it cannot be decoded."""
        reading = self._read_bytes(data) if self._read_bytes is not None else None
        if reading is not None:
            return reading
        message = self._input.decode(data)
        return None if message is None else self._read(message)


def actuator_input(wiring: Wiring) -> ArrayInput:
    """Subscribe to the actuator channels."""
    settings = wiring.identifier.settings.actuators
    reader = ActuatorReader(settings)
    return ArrayInput(
        wiring,
        settings.type,
        ACTUATORS_TOPIC,
        reader,
        wiring.identifier.add_actuators,
        _bytes_reader(settings.type, reader),
    )


def _bytes_reader(
    type_name: str, reader: ActuatorReader
) -> Callable[[bytes], Reading | None] | None:
    """Return what reads the channels from bytes, for the types where that is possible."""
    if not ChannelsDecoder.knows(type_name, reader.field):
        return None
    decode = ChannelsDecoder(type_name, reader.field)

    def read(data: bytes) -> Reading | None:
        reading = decode(data)
        return None if reading is None else reader.select(reading)

    return read


def airspeed_input(wiring: Wiring) -> ArrayInput:
    """Subscribe to the airspeed, for vehicles that have one."""
    identifier = wiring.identifier
    name = identifier.settings.airspeed.type
    return _optional_input(wiring, name, AIRSPEED_TOPIC, AIRSPEED[name], identifier.add_airspeed)


def armed_input(wiring: Wiring) -> ArrayInput:
    """Subscribe to whether the vehicle is armed, for autopilots that say it."""
    identifier = wiring.identifier
    name = identifier.settings.armed.type
    return _optional_input(wiring, name, ARMED_TOPIC, ARMED[name], identifier.add_armed)


def excitation_input(wiring: Wiring) -> ArrayInput:
    """Subscribe to what somebody injects into the inputs on purpose."""
    add = wiring.identifier.add_excitation
    return ArrayInput(wiring, EXCITATION_TYPE, EXCITATION_TOPIC, read_excitation, add)


def _optional_input(
    wiring: Wiring,
    type_name: str,
    topic: str,
    read: Callable[[Any], Reading],
    add: Callable[[int, Any], Drop | None],
) -> ArrayInput:
    """Subscribe to what may come on any clock: nothing is lost if it counts some ms later."""

    def say(seconds: float) -> None:
        name = wiring.node.resolve_topic_name(topic)
        wiring.node.get_logger().info(
            f"'{name}': its messages carry no time and arrive {seconds:+.1f} s from the Imu's "
            "stamps: each counts from the newest of them"
        )

    arrivals = Arrivals(wiring.identifier, add, say)
    return ArrayInput(wiring, type_name, topic, read, add, arrivals=arrivals)
