# SPDX-License-Identifier: Apache-2.0
"""Bad messages are dropped, counted and named; the estimate is as if they had never come."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from recordings import (
    ACTUATORS_TOPIC,
    RATES_TOPIC,
    Fly,
    Recording,
    published,
    recording,
    replayed,
    wait_for_status,
    wait_for_words,
)

from uav_ident_ros.bags.reading import Message
from uav_ident_ros.player import Player

EVERY = 20
"""One message in so many is followed by a bad one."""

OUTLYING_S = 10
"""Far outside of `time_jump`, s."""


def set_rate(value: float) -> Callable[[Any], None]:
    def change(imu: Any) -> None:
        imu.angular_velocity.y = value

    return change


def no_rates(imu: Any) -> None:
    imu.angular_velocity_covariance[0] = -1.0


def bad_force(imu: Any) -> None:
    imu.linear_acceleration.z = math.nan


def zero_stamp(message: Any) -> None:
    message.header.stamp.sec = message.header.stamp.nanosec = 0


def future_stamp(message: Any) -> None:
    message.header.stamp.sec += OUTLYING_S


def past_stamp(message: Any) -> None:
    message.header.stamp.sec -= OUTLYING_S


def set_channel(value: float) -> Callable[[Any], None]:
    def change(state: Any) -> None:
        state.position[2] = value

    return change


def short_array(state: Any) -> None:
    state.position = state.position[:2]


def other_names(state: Any) -> None:
    state.name = ["flaps", "gear", "brake", "light"]


# Topic, change, and the reason under which it is counted.
BAD: list[tuple[str, Callable[[Any], None], str]] = [
    (RATES_TOPIC, set_rate(math.nan), "not finite"),
    (RATES_TOPIC, set_rate(-math.inf), "not finite"),
    (RATES_TOPIC, bad_force, "not finite"),
    (RATES_TOPIC, no_rates, "no rates"),
    (RATES_TOPIC, zero_stamp, "zero or negative stamp"),
    (RATES_TOPIC, future_stamp, "outlying stamp"),
    (RATES_TOPIC, past_stamp, "outlying stamp"),
    (ACTUATORS_TOPIC, set_channel(math.nan), "not finite"),
    (ACTUATORS_TOPIC, set_channel(math.inf), "not finite"),
    (ACTUATORS_TOPIC, short_array, "wrong channels"),
    (ACTUATORS_TOPIC, other_names, "wrong channels"),
    (ACTUATORS_TOPIC, zero_stamp, "zero or negative stamp"),
    (ACTUATORS_TOPIC, future_stamp, "stamp far from the Imu's"),
]

PLAIN_REASONS = {"zero or negative stamp", "outlying stamp", "stamp far from the Imu's"}
"""Reasons that the log gives without a detail."""

FLOOD = 300
"""Bad messages of a flood."""

AT_ONCE = 50
"""So many in a burst that DDS loses none of them."""

UNDECODABLE = b"\x00\x01\x00\x00\x01"
"""The beginning of a message."""


def with_bad_messages(flight: Recording) -> Iterator[tuple[Message, str]]:
    """Messages of a flight with bad ones in between, and the reason of each bad one."""
    position = 0
    for number, message in enumerate(flight.messages):
        yield message, ""
        if number % EVERY != EVERY - 1:
            continue
        topic, change, reason = BAD[position % len(BAD)]
        position += 1
        if topic != message.topic:
            message = next(m for m in flight.messages[number:] if m.topic == topic)
        bad = deserialize_message(message.data, flight.classes[topic])
        change(bad)
        yield Message(topic, flight.messages[number].log_ns, serialize_message(bad)), reason


@pytest.fixture
def flight() -> Recording:
    return recording("multisine", 8.0)


def drops(player: Player, stream: str) -> dict[str, int]:
    """Drops by reason, from the newest diagnostics."""
    prefix = f"{stream}: dropped: "
    return {
        entry.key.removeprefix(prefix): int(entry.value)
        for entry in player.outputs.status[-1].values
        if entry.key.startswith(prefix)
    }


def test_bad_messages_leave_no_trace_in_the_estimate(
    flight: Recording, fly: Fly, tmp_path: Path
) -> None:
    """On system time, with the events executor: the same to the bit as a replay, too."""
    node, player = fly(flight)
    played = list(with_bad_messages(flight))
    player.play_in_step([message for message, _ in played])
    wait_for_status(player)
    assert published(player.outputs) == replayed(flight, tmp_path)
    for stream, topic in (("rates", RATES_TOPIC), ("actuators", ACTUATORS_TOPIC)):
        reasons = [reason for message, reason in played if reason and message.topic == topic]
        assert drops(player, stream) == {r: reasons.count(r) for r in set(reasons)}
        for reason in set(reasons) & PLAIN_REASONS:
            assert f"'{topic}': message dropped: {reason}" in node.log
    assert f"'{RATES_TOPIC}': message dropped: angular_velocity_covariance[0] is -1" in node.log
    assert f"'{ACTUATORS_TOPIC}': message dropped: 'position' has 2 values" in node.log


def test_a_flood_of_bad_messages_is_named_once_and_a_frame_that_contradicts_is_a_fault(
    flight: Recording, fly: Fly
) -> None:
    node, player = fly(flight)
    for number in range(FLOOD):
        player.send(RATES_TOPIC, UNDECODABLE)
        player.send(ACTUATORS_TOPIC, UNDECODABLE)
        if number % AT_ONCE == 0:
            player.spin_for(0.05)
    player.wait_until(
        lambda: (
            bool(player.outputs.status)
            and drops(player, "rates").get("not decodable") == FLOOD
            and drops(player, "actuators").get("not decodable") == FLOOD
        ),
        "the count of the messages that cannot be decoded",
    )
    assert node.log.count(f"'{RATES_TOPIC}': message dropped: it cannot be decoded") <= 3
    player.play_in_step(flight.messages[:1000])
    assert player.outputs.named
    player.outputs.clear()
    for message in flight.messages[:50]:
        if message.topic == RATES_TOPIC:
            imu = deserialize_message(message.data, flight.classes[RATES_TOPIC])
            imu.header.frame_id = "base_link_frd"
            player.send(RATES_TOPIC, imu)
    wait_for_words(player, "fault: the Imu's frame_id 'base_link_frd' contradicts")
    assert drops(player, "rates")["wrong frame"] > 0
    assert player.outputs.named == []
