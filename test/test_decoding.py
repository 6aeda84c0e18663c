# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 2's serializer, with reserved but unused bytes at the end."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from excerpts import written
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Bool, Float32MultiArray, Float64MultiArray, MultiArrayDimension

from uav_ident_ros.bags.reading import Bag, BagError
from uav_ident_ros.bags.writing import jazzy_types


def joint_state(counts: tuple[int, ...], letters: int = 3) -> JointState:
    message = JointState(name=["c" * k for k in range(counts[0])])
    message.header.frame_id = "f" * letters
    fields = ("position", "velocity", "effort")
    for tens, field, count in zip((10.0, 20.0, 30.0), fields, counts, strict=True):
        setattr(message, field, [tens + k for k in range(count)])
    return message


def array(kind: Any, values: list[float], label: str) -> Any:
    message = kind(data=values)
    message.layout.dim = [MultiArrayDimension(label=label)]
    return message


MESSAGES: dict[str, list[Any]] = {
    "sensor_msgs/msg/JointState": [
        joint_state(counts, letters)
        for counts in itertools.product((0, 1, 4), repeat=3)
        for letters in range(8)
    ],
    "std_msgs/msg/Float64MultiArray": [
        array(Float64MultiArray, [0.5] * n, "l" * k) for n in (0, 3) for k in range(8)
    ],
    "std_msgs/msg/Float32MultiArray": [array(Float32MultiArray, [0.5] * n, "") for n in (0, 3)],
    "std_msgs/msg/Bool": [Bool(data=True)],
    "sensor_msgs/msg/Imu": [Imu()],
}


def recorded(path: Path, msgtype: str, serialized: list[bytes]) -> Bag:
    """Write serialized messages, and open the bag."""
    messages = [("/a", log_ns, data) for log_ns, data in enumerate(serialized, 1)]
    return Bag(written(path, {"/a": msgtype}, messages))


@pytest.mark.parametrize("msgtype", MESSAGES)
def test_bytes_after_a_message_are_ignored_as_in_rclpy(msgtype: str, tmp_path: Path) -> None:
    """The serializer aligns for the elements of an empty sequence; others append any bytes."""
    messages = MESSAGES[msgtype]
    serialized = [serialize_message(message) + bytes(20 * (k % 2)) for k, message in
                  enumerate(messages)]  # fmt: skip
    with recorded(tmp_path / "bag", msgtype, serialized) as bag:
        decode = bag.decoder("/a")
        for recording, message in zip(bag.messages(["/a"]), messages, strict=True):
            assert deserialize_message(recording.data, type(message)) == message
            written = jazzy_types().serialize_cdr(decode(recording.data), msgtype)
            assert deserialize_message(bytes(written), type(message)) == message


def test_bytes_of_no_valid_message_are_refused(tmp_path: Path) -> None:
    whole = [serialize_message(joint_state((4, n, n))) for n in (0, 4)]
    spoiled = [
        *(data[:-12] for data in whole),
        whole[0][:4] + np.random.default_rng(1).bytes(len(whole[0]) - 4),
        b"\x00\x07" + whole[1][2:],
        b"",
    ]
    with recorded(tmp_path / "bag", "sensor_msgs/msg/JointState", spoiled) as bag:
        decode = bag.decoder("/a")
        for message in bag.messages(["/a"]):
            with pytest.raises(BagError, match=r"on '/a' is no sensor_msgs/msg/JointState: "):
                decode(message.data)
