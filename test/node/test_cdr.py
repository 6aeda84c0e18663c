# SPDX-License-Identifier: Apache-2.0
"""Messages read and written as bytes agree with rclpy's own, and bad bytes do no harm."""

from __future__ import annotations

import random
import struct
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Vector3, Vector3Stamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import (
    Float32MultiArray,
    Float64MultiArray,
    Header,
    MultiArrayDimension,
    MultiArrayLayout,
)

from uav_ident_ros.messages.cdr import ChannelsDecoder, Template
from uav_ident_ros.messages.types import ACTUATORS
from uav_ident_ros.player import to_stamp

TYPES = {
    "sensor_msgs/msg/JointState": (JointState, "position"),
    "std_msgs/msg/Float64MultiArray": (Float64MultiArray, "data"),
    "std_msgs/msg/Float32MultiArray": (Float32MultiArray, "data"),
}

STREAMS = 60
"""Forms of message tried for each type."""


def some_text(chance: random.Random) -> str:
    return "".join(chance.choice("aé_/0") for _ in range(chance.randrange(8)))


def form(chance: random.Random, kind: type) -> Any:
    """A message of some form, without its numbers."""
    if kind is JointState:
        header = Header(frame_id=some_text(chance))
        names = [some_text(chance) for _ in range(chance.randrange(6))]
        return JointState(header=header, name=names)
    dim = [
        MultiArrayDimension(label=some_text(chance), size=chance.randrange(9), stride=3)
        for _ in range(chance.randrange(3))
    ]
    return kind(layout=MultiArrayLayout(dim=dim, data_offset=chance.randrange(5)))


def fill(chance: random.Random, message: Any, field: str, count: int) -> None:
    """Give the message numbers and, if it has one, a stamp."""
    setattr(message, field, [chance.uniform(-9.0, 9.0) for _ in range(count)])
    if isinstance(message, JointState):
        message.header.stamp = to_stamp(chance.randrange(2**60))
        message.effort = [chance.random() for _ in range(chance.choice((0, count)))]


@pytest.mark.parametrize("name", TYPES)
def test_channels_are_those_that_rclpy_decodes(name: str) -> None:
    chance = random.Random(1)
    kind, field = TYPES[name]
    decode = ChannelsDecoder(name, field)
    for _ in range(STREAMS):
        message, count = form(chance, kind), chance.randrange(7)
        for _ in range(3):
            fill(chance, message, field, count)
            found = decode(serialize_message(message))
            wanted = ACTUATORS[name].read(message, field)
            assert found is not None
            assert found.stamp_ns == wanted.stamp_ns
            assert list(found.values) == list(wanted.values)
            assert (found.names is None) == (wanted.names is None)
            assert list(found.names or []) == list(wanted.names or [])


@pytest.mark.parametrize("name", TYPES)
def test_cut_or_changed_bytes_are_left_to_rclpy_or_read_alike(name: str) -> None:
    chance = random.Random(2)
    kind, field = TYPES[name]
    for _ in range(STREAMS):
        message = form(chance, kind)
        fill(chance, message, field, 4)
        whole = serialize_message(message)
        decode = ChannelsDecoder(name, field)
        assert decode(whole) is not None
        assert decode(whole[: chance.randrange(len(whole) - 4 * 4)]) is None
        changed = bytearray(whole)
        changed[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
        found = decode(bytes(changed))
        if found is None:
            continue
        try:
            wanted = ACTUATORS[name].read(deserialize_message(bytes(changed), kind), field)
        except (RuntimeError, UnicodeDecodeError):
            continue  # what comes after the channels was hit
        assert np.array_equal(found.values, wanted.values, equal_nan=True)
        assert found.stamp_ns == wanted.stamp_ns


def test_other_byte_order_is_read_too() -> None:
    message = Float64MultiArray(data=[1.5, -2.5])
    little = serialize_message(message)
    assert little[:2] == b"\x00\x01"
    words = struct.unpack("<3I", little[4:16])
    big = b"\x00\x00\x00\x00" + struct.pack(">3I", *words) + b"\x00" * (len(little) - 32)
    big += struct.pack(">2d", 1.5, -2.5)
    decode = ChannelsDecoder("std_msgs/msg/Float64MultiArray", "data")
    for data in (little, big, little):
        found = decode(data)
        assert found is not None
        assert found.values == (1.5, -2.5)


@pytest.mark.parametrize("size", [0, 1, 3, 4, 11])
def test_a_message_of_too_few_bytes_is_of_another_form(size: int) -> None:
    """The first one, too, before anything is known to compare it with."""
    for name, field in (
        ("std_msgs/msg/Float64MultiArray", "data"),
        ("sensor_msgs/msg/JointState", "position"),
    ):
        decode = ChannelsDecoder(name, field)
        assert decode(bytes(size)) is None
        assert decode(bytes(size)) is None


def test_a_template_is_what_rclpy_serializes() -> None:
    mark = np.pi * np.arange(1.0, 4.0)
    vector = Vector3(**dict(zip("xyz", mark.tolist(), strict=True)))
    template = Template(Vector3Stamped(header=Header(frame_id="imu"), vector=vector), [mark])
    values = np.array([0.5, np.inf, -0.0])
    template.stamp(1_700_000_000_123_456_789)
    message = Vector3Stamped(
        header=Header(stamp=to_stamp(1_700_000_000_123_456_789), frame_id="imu"),
        vector=Vector3(**dict(zip("xyz", values.tolist(), strict=True))),
    )
    assert template.filled(values) == serialize_message(message)
    assert template.filled(np.zeros(3, dtype=np.int64)).endswith(b"\x00" * 24)
    with pytest.raises(ValueError, match="2 numbers do not fit"):
        template.filled(np.zeros(2))
    with pytest.raises(ValueError, match="stands 0 times"):
        Template(Vector3Stamped(), [mark])
