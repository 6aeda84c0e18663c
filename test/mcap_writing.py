# SPDX-License-Identifier: Apache-2.0
"""A flight as a recorder writes it: chunks, checksums, compression, by the mcap library itself."""

from pathlib import Path

from excerpts import BAGS
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.bags.writing import jazzy_types

TYPES = {"/imu/data": "sensor_msgs/msg/Imu", "/actuators": "sensor_msgs/msg/JointState"}

CHUNK = 100_000
"""Size of the chunks, bytes: about a second of the flight."""


def rewritten(
    target: Path,
    *,
    compression: CompressionType = CompressionType.NONE,
    use_chunking: bool = True,
    seconds: float,
    chunk: int = CHUNK,
) -> Path:
    """Write the start of a flight: small chunks, with checksums."""
    with Bag(BAGS / "multisine") as bag, target.open("wb") as file:
        writer = McapWriter(
            file, chunk_size=chunk, compression=compression, use_chunking=use_chunking
        )
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, name in TYPES.items():
            definition = jazzy_types().generate_msgdef(name)[0].encode()
            schema = writer.register_schema(name, "ros2msg", definition)
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, log_ns, data in bag.messages(TYPES):
            if log_ns <= bag.start_ns + seconds * 1e9:
                writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()
    return target
