# SPDX-License-Identifier: Apache-2.0
"""Reading bags: order, foreign types, and a one-line error for every problem."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from excerpts import one_folder, written
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from programs import python
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uav_ident_ros.bags import writing
from uav_ident_ros.bags.reading import Bag, BagError
from uav_ident_ros.bags.writing import ARRAY
from uav_ident_ros.messages.feed import decode_imu_cdr

FOREIGN = "px4_msgs/msg/ActuatorServos"
FOREIGN_TEXT = "uint64 timestamp\nuint64 timestamp_sample\nfloat32[8] control\n"


def array(value: float) -> Any:
    return writing.array([float(value)])


def write(path: Path, *, compress: bool = False) -> Path:
    """Write two topics whose messages were recorded out of order."""
    times = (30, 10, 20, 50, 40)
    messages = [("/a" if log_ns % 20 else "/b", log_ns, array(log_ns)) for log_ns in times]
    return written(path, {"/a": ARRAY, "/b": ARRAY}, messages, compress=compress)


def mcap(path: Path) -> Path:
    return path / f"{path.name}.mcap"


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("form", ["folder", "file", "no metadata", "metadata file"])
def test_messages_are_in_log_time_order(form: str, compress: bool, tmp_path: Path) -> None:
    path = write(tmp_path / "bag", compress=compress)
    if form == "no metadata":
        (path / "metadata.yaml").unlink()
    damage = {"no metadata": ["there is no metadata.yaml: the files were read without it"]}
    opened = {"file": mcap(path), "metadata file": path / "metadata.yaml"}.get(form, path)
    with Bag(opened) as bag:
        assert bag.types == {"/a": ARRAY, "/b": ARRAY}
        assert bag.counts == {"/a": 3, "/b": 2}
        assert (bag.start_ns, bag.end_ns) == (10, 50)
        decode = bag.decoder("/a")
        read = [(m.topic, m.log_ns, decode(m.data).data[0]) for m in bag.messages(["/a", "/b"])]
        only_b = [m.log_ns for m in bag.messages(["/b"])]
        assert bag.damage == damage.get(form, [])
    assert read == [("/a", 10, 10), ("/b", 20, 20), ("/a", 30, 30), ("/b", 40, 40), ("/a", 50, 50)]
    assert only_b == [20, 40]


def test_files_without_metadata_are_ordered_by_their_log_times(tmp_path: Path) -> None:
    bags = [
        written(tmp_path / name, {"/a": ARRAY}, [("/a", log_ns, array(0.0))])
        for name, log_ns in (("z", 1), ("a", 2))
    ]
    with Bag(one_folder(tmp_path / "split", *bags)) as bag:
        assert [m.log_ns for m in bag.messages(["/a"])] == [1, 2]
        assert bag.counts == {"/a": 2}


def write_foreign(path: Path, storage: StoragePlugin) -> Path:
    """Write a message of a type that ROS 2's interfaces lack."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(FOREIGN_TEXT, FOREIGN))
    message = store.types[FOREIGN](5, 4, np.arange(8, dtype=np.float32))
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection("/servos", FOREIGN, typestore=store)
        writer.write(connection, 1, store.serialize_cdr(message, FOREIGN))
    return path


def test_a_foreign_type_is_read_by_its_definition_in_the_bag(tmp_path: Path) -> None:
    with Bag(write_foreign(tmp_path / "bag", StoragePlugin.MCAP)) as bag:
        decode = bag.decoder("/servos")
        (read,) = [decode(m.data) for m in bag.messages(["/servos"])]
    assert read.timestamp_sample == 4
    assert read.control.tolist() == [*range(8)]


def test_a_foreign_type_without_a_valid_definition_is_refused(tmp_path: Path) -> None:
    path = write_foreign(tmp_path / "none", StoragePlugin.SQLITE3)
    with closing(sqlite3.connect(path / "none.db3")) as database, database:
        database.execute("DELETE FROM message_definitions")
    with Bag(path) as bag, pytest.raises(BagError, match=f"unknown type {FOREIGN}"):
        bag.decoder("/servos")
    file = mcap(write_foreign(tmp_path / "broken", StoragePlugin.MCAP))
    file.write_bytes(file.read_bytes().replace(b"float32[8]", b"float32[[8"))
    with Bag(file) as bag, pytest.raises(BagError, match=f"definition of {FOREIGN} of .*'/servos'"):
        bag.decoder("/servos")


def write_ros1(path: Path, compression: Any = None) -> None:
    """Write a bag of ROS 1: an Imu, and a message that ROS 2's interfaces lack."""
    store = get_typestore(Stores.ROS1_NOETIC)
    name, text = "mavros_msgs/msg/ServoOutputRaw", "Header header\nuint8 port\nuint16[] channels\n"
    header = "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    store.register(get_types_from_msg(f"{text}{'=' * 80}\n{header}", name))
    make = store.types
    vector = make["geometry_msgs/msg/Vector3"]
    turn = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    zero, force = np.zeros(9), vector(0.0, 0.0, 9.8)
    opened = Ros1Writer(path)
    if compression is not None:
        opened.set_compression(compression)
    with opened as writer:
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        servos = writer.add_connection("/servos", name, typestore=store)
        for k in range(1, 400):
            stamp = make["builtin_interfaces/msg/Time"](sec=100, nanosec=k * 2_000_000)
            header = make["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="base_link")
            rates = vector(0.1 * k, 0.0, -0.1 * k)
            message = make[imu.msgtype](header, turn, zero, rates, zero, force, zero)
            writer.write(imu, k, store.serialize_ros1(message, imu.msgtype))
            pulses = np.array([1500 + k, 1500 - k], dtype=np.uint16)
            writer.write(servos, k, store.serialize_ros1(make[name](header, 0, pulses), name))


@pytest.mark.parametrize("compression", [None, *Ros1Writer.CompressionFormat], ids=str)
def test_a_ros_1_bag_is_read_with_its_definitions(compression: Any, tmp_path: Path) -> None:
    write_ros1(tmp_path / "old.bag", compression)
    with Bag(tmp_path / "old.bag") as bag:
        assert bag.types == {
            "/imu": "sensor_msgs/msg/Imu",
            "/servos": "mavros_msgs/msg/ServoOutputRaw",
        }
        decode = {topic: bag.decoder(topic) for topic in bag.types}
        read = [(m.topic, m.log_ns, decode[m.topic](m.data), m.data) for m in bag.messages(decode)]
    rates = [m.angular_velocity.x for topic, _, m, _ in read if topic == "/imu"]
    pulses = [m.channels[0] for topic, _, m, _ in read if topic == "/servos"]
    assert rates == [0.1 * k for k in range(1, 400)]
    assert pulses == [1500 + k for k in range(1, 400)]
    imu = next(data for topic, log_ns, _, data in read if topic == "/imu" and log_ns == 7)
    reading = decode_imu_cdr(imu)  # by the identifier's reader
    assert reading is not None
    assert (reading.stamp_ns, reading.frame_id) == (100_014_000_000, "base_link")


def test_a_database_is_read_without_metadata_and_refused_if_truncated(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/a", ARRAY, typestore=store)
        for log_ns in range(1, 2001):
            writer.write(connection, log_ns, store.serialize_cdr(array(log_ns), ARRAY))
    (path / "metadata.yaml").unlink()
    with Bag(path) as bag:
        assert bag.damage == ["there is no metadata.yaml: the files were read without it"]
        assert len(list(bag.messages(["/a"]))) == 2000
    file = path / "bag.db3"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(BagError) as caught:
        Bag(path)
    assert str(caught.value).startswith(f"bag '{path}' cannot be read: ")
    assert "malformed" in str(caught.value)
    assert str(caught.value).endswith("(the tool sqlite3 may save what is there, by '.recover')")


def test_the_error_of_an_unknown_topic_lists_the_topics(tmp_path: Path) -> None:
    with Bag(write(tmp_path / "bag")) as bag:
        for query in (lambda: bag.decoder("/c"), lambda: next(bag.messages(["/c"]))):
            with pytest.raises(BagError, match=rf"no topic '/c'; it has /a \({ARRAY}\), /b"):
                query()


def test_a_topic_of_two_types_is_refused_where_it_is_read(tmp_path: Path) -> None:
    """Bytes of one type may be taken for another: what follows a message is skipped."""
    bags = []
    for name, msgtype in (("first", ARRAY), ("second", "std_msgs/msg/Float32MultiArray")):
        types = {"/a": msgtype, f"/{name}": msgtype}
        bags.append(written(tmp_path / name, types, [(topic, 1, bytes(28)) for topic in types]))
    with Bag(one_folder(tmp_path / "both", *bags)) as bag:
        bag.decoder("/first")
        with pytest.raises(BagError, match=r"'/a' has two types, .*Float64.* and .*Float32"):
            bag.decoder("/a")


def test_missing_foreign_and_damaged_files_are_refused_by_name(tmp_path: Path) -> None:
    write_ros1(tmp_path / "old.bag")
    content = (tmp_path / "old.bag").read_bytes()
    for name, damaged in (("cut", content[: len(content) // 2]), ("none", b""), ("no", b"no bag")):
        (tmp_path / f"{name}.bag").write_bytes(damaged)
    mcap(write(tmp_path / "lost")).unlink()
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "text.mcap").write_text("hello")
    (tmp_path / "nothing.mcap").write_bytes(b"")
    for name, words in (
        ("nowhere", "'.*nowhere' does not exist"),
        ("empty", r"has no \.mcap or \.db3 or \.bag file, and there is no metadata\.yaml"),
        ("notes.txt", "is no bag: an .mcap file, a rosbag2 folder or a .bag of ROS 1"),
        ("text.mcap", "'text.mcap': .*: it is no MCAP file"),
        ("nothing.mcap", "'nothing.mcap' seems to be empty"),
        ("lost", "files are missing"),
        *((f"{name}.bag", f"'.*{name}.bag' cannot be read") for name in ("cut", "none", "no")),
    ):
        with pytest.raises(BagError, match=words):
            Bag(tmp_path / name)


def test_wrong_metadata_is_reported_and_ignored(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    for text, words in (
        ("rosbag2_bagfile_information: {}\n", "A metadata key is missing"),
        ("[", "Could not load YAML"),
    ):
        (path / "metadata.yaml").write_text(text)
        with Bag(path) as bag:
            (line,) = bag.damage
            assert line.startswith(f"metadata.yaml cannot be used ({words}")
            assert line.endswith("): the files were read without it")
            assert "\n" not in line
            assert str(tmp_path) not in line
            assert len(list(bag.messages(["/a", "/b"]))) == 5


BOMB = 300 * 2**20


def bomb(path: Path, compression: CompressionType, printed: int) -> Path:
    """Write a bag whose only chunk inflates to `BOMB` bytes or more, but declares `printed`."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=2 * BOMB, compression=compression)
        writer.start(profile="ros2", library="test")
        channel = writer.register_channel("/a", "cdr", 0)
        writer.add_message(channel, 1, bytes(BOMB), 1)
        writer.finish()
    if printed < BOMB:
        with path.open("rb") as file:
            (chunk,) = make_reader(file).get_summary().chunk_indexes
        size = chunk.uncompressed_size.to_bytes(8, "little")
        path.write_bytes(path.read_bytes().replace(size, printed.to_bytes(8, "little"), 1))
    return path


def test_decompression_of_a_chunk_stops_at_the_limit(tmp_path: Path) -> None:
    """The limit holds for any declared size."""
    paths = [
        bomb(tmp_path / f"{compression.name}_{printed}.mcap", compression, printed)
        for compression in (CompressionType.ZSTD, CompressionType.LZ4)
        for printed in (1000, BOMB)
    ]
    assert max(path.stat().st_size for path in paths) < 2 * 2**20
    program = (
        "import re\n"
        "from uav_ident_ros.bags.reading import Bag, BagError\n"
        f"for path in {[str(path) for path in paths]}:\n"
        "    try:\n"
        "        with Bag(path) as bag: list(bag.messages(bag.types))\n"
        "    except BagError as error: print(error)\n"
        # not ru_maxrss, which starts at the memory of the parent process
        "peak = re.search(r'VmHWM:[^0-9]+([0-9]+) kB', open('/proc/self/status').read())\n"
        "print(int(peak[1]) // 1024)\n"
    )
    done = python("-c", program)
    *lines, peak = done.stdout.splitlines()
    assert len(lines) == len(paths), done.stderr
    for path, line in zip(paths, lines, strict=True):
        assert path.name in line
        assert "a chunk holds more than 64 MiB when it is decompressed" in line
    assert int(peak) < 500  # MiB


def test_decompression_of_a_file_stops_at_the_limit(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    file = mcap(path)
    content = zstandard.compress(file.read_bytes() + bytes(80 * 2**20))
    file.with_suffix(".mcap.zstd").write_bytes(content)
    file.unlink()
    text = (path / "metadata.yaml").read_text()
    text = text.replace("bag.mcap", "bag.mcap.zstd").replace("bag.mcap.zstd.zstd", "bag.mcap.zstd")
    text = text.replace("compression_format: ''", "compression_format: zstd")
    text = text.replace("compression_mode: ''", "compression_mode: file")
    (path / "metadata.yaml").write_text(text)
    with pytest.raises(BagError, match="the compressed file holds more than 64 MiB"):
        Bag(path)


def test_an_error_of_the_caller_is_not_converted(tmp_path: Path) -> None:
    with Bag(write(tmp_path / "bag")) as bag, pytest.raises(ZeroDivisionError):
        for _ in bag.messages(["/a"]):
            raise ZeroDivisionError
