# SPDX-License-Identifier: Apache-2.0
"""Messages as ROS 2's own serializer leaves them, with room that it has reserved and not used."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Bool, Float32MultiArray, Float64MultiArray, MultiArrayDimension

from uav_ident_ros.bags.reading import Bag, BagError
from uav_ident_ros.bags.writing import jazzy_types

FIELDS = ("position", "velocity", "effort")


def joint_state(counts: tuple[int, ...], letters: int) -> JointState:
    message = JointState(name=["c" * k for k in range(counts[0])])
    message.header.frame_id = "f" * letters
    for tens, field, count in zip((10.0, 20.0, 30.0), FIELDS, counts, strict=True):
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


def recorded(path: Path, msgtype: str, serialized: list[bytes]) -> Path:
    """Write serialized messages, as `rosbag2_py` records them."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/a", msgtype, typestore=jazzy_types())
        for log_ns, data in enumerate(serialized, 1):
            writer.write(connection, log_ns, data)
    return path


def decoded(path: Path) -> list[Any]:
    with Bag(path) as bag:
        decode = bag.decoder("/a")
        return [decode(message.data) for message in bag.messages(["/a"])]


@pytest.mark.parametrize("msgtype", MESSAGES)
def test_room_that_the_serializer_of_ros_has_not_used(msgtype: str, tmp_path: Path) -> None:
    """It aligns for the elements of an empty sequence; what it then hands over is no message."""
    messages = MESSAGES[msgtype]
    serialized = [serialize_message(message) for message in messages]
    for read, message in zip(
        decoded(recorded(tmp_path / "bag", msgtype, serialized)), messages, strict=True
    ):
        written = jazzy_types().serialize_cdr(read, msgtype)
        assert deserialize_message(bytes(written), type(message)) == message


def test_bytes_that_no_serializer_leaves(tmp_path: Path) -> None:
    """The room is exact: what is longer, or cut, or another message behind it, is none."""
    whole = [serialize_message(joint_state((4, n, n), 3)) for n in (0, 4)]
    spoiled = [
        *(data + bytes(4) for data in whole),  # up to three bytes round a message up
        *(data[:-12] for data in whole),
        *(data + data[4:] for data in whole),
        whole[0][:4] + np.random.default_rng(1).bytes(len(whole[0]) - 4),
        b"\x00\x07" + whole[1][2:],
    ]
    with Bag(recorded(tmp_path / "bag", "sensor_msgs/msg/JointState", spoiled)) as bag:
        decode = bag.decoder("/a")
        for message in bag.messages(["/a"]):
            with pytest.raises(BagError, match=r"on '/a' is no sensor_msgs/msg/JointState: "):
                decode(message.data)
