# SPDX-License-Identifier: Apache-2.0
"""Bad messages are dropped, counted and named, without an effect on the estimate."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from recordings import ACTUATORS_TOPIC, RATES_TOPIC, Fly, Recording, Spoil, put, recording

from uav_ident_ros.bags.reading import Message
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.ros import to_stamp

EVERY = 20
"""A bad message follows every 20th message."""

OUTLYING_S = 10
"""Far outside of `time_jump`, s."""

LATE_S = -0.2
"""Before an already computed tick, s."""

TRUNCATED = b"\x00\x01\x00\x00\x01"


def stamped(seconds: float) -> Spoil:
    """Return a function that shifts the stamp by some seconds; 0 clears the stamp."""

    def change(message: Any) -> None:
        moved_ns = header_ns(message) + round(seconds * 1e9) if seconds else 0
        message.header.stamp = to_stamp(moved_ns)

    return change


# Topic, change, and the drop reason.
BAD: list[tuple[str, Spoil, str]] = [
    (RATES_TOPIC, put("angular_velocity.y", math.nan), "not finite"),
    (RATES_TOPIC, put("angular_velocity.y", -math.inf), "not finite"),
    (RATES_TOPIC, put("linear_acceleration.z", math.nan), "not finite"),
    (RATES_TOPIC, put("angular_velocity_covariance", [-1.0] + [0.0] * 8), "no rates"),
    (RATES_TOPIC, stamped(0), "zero or negative stamp"),
    (RATES_TOPIC, stamped(OUTLYING_S), "outlying stamp"),
    (RATES_TOPIC, stamped(-OUTLYING_S), "outlying stamp"),
    (ACTUATORS_TOPIC, put("position", [0.0, 0.0, math.nan, 0.0]), "not finite"),
    (ACTUATORS_TOPIC, put("position", [0.0, 0.0, math.inf, 0.0]), "not finite"),
    (ACTUATORS_TOPIC, put("position", [0.0, 0.0]), "wrong channels"),
    (ACTUATORS_TOPIC, put("name", ["flaps", "gear", "brake", "light"]), "wrong channels"),
    (ACTUATORS_TOPIC, stamped(0), "zero or negative stamp"),
    (ACTUATORS_TOPIC, stamped(OUTLYING_S), "stamp far from the Imu's"),
    (RATES_TOPIC, put("angular_velocity.y", 1.0), "repeated stamp"),
    (ACTUATORS_TOPIC, put("position", [0.1, 0.1, 0.1, 0.1]), "repeated stamp"),
    (RATES_TOPIC, stamped(LATE_S), "late"),
    (ACTUATORS_TOPIC, stamped(LATE_S), "late"),
    (RATES_TOPIC, lambda _: TRUNCATED, "not decodable"),
    (ACTUATORS_TOPIC, lambda _: TRUNCATED, "not decodable"),
]

PLAIN_REASONS = {"zero or negative stamp", "outlying stamp", "stamp far from the Imu's"}
"""Reasons without a detail in the log."""


def with_bad_messages(flight: Recording) -> Iterator[tuple[Message, str]]:
    """Yield a flight's messages with bad ones in between, and each drop reason."""
    position = 0
    for number, message in enumerate(flight.messages):
        yield message, ""
        if number % EVERY != EVERY - 1 or number > len(flight.messages) - 5 * EVERY:
            continue  # no tick comes due at the end
        topic, change, reason = BAD[position % len(BAD)]
        position += 1
        newest = next(m for m in flight.messages[number::-1] if m.topic == topic)
        bad = deserialize_message(newest.data, flight.classes[topic])
        data = change(bad) or serialize_message(bad)
        yield Message(topic, message.log_ns, data), reason


def test_bad_messages_have_no_effect_on_the_estimate(fly: Fly, tmp_path: Path) -> None:
    """On system time, with the events executor; the reference is a replay."""
    flight = recording("multisine", 8.0)
    node, player = fly(flight)
    played = list(with_bad_messages(flight))
    player.play_in_step([message for message, _ in played])
    values = player.entries()
    assert player.ticks() == flight.replayed(tmp_path)
    for stream, topic in (("rates", RATES_TOPIC), ("actuators", ACTUATORS_TOPIC)):
        reasons = [reason for message, reason in played if reason and message.topic == topic]
        counted = {name: int(n) for name, n in values.items() if f"{stream}: dropped: " in name}
        assert counted == {f"{stream}: dropped: {r}": reasons.count(r) for r in set(reasons)}
        for reason in set(reasons) & PLAIN_REASONS:
            assert f"'{topic}': message dropped: {reason}" in node.log
    assert f"'{RATES_TOPIC}': message dropped: angular_velocity_covariance[0] is -1" in node.log
    assert f"'{ACTUATORS_TOPIC}': message dropped: 'position' has 2 values" in node.log
