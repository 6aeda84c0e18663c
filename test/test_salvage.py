# SPDX-License-Identifier: Apache-2.0
"""Damaged bags: one line reports the loss, and all other messages are used."""

import math
from pathlib import Path
from typing import Any

import excerpts
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from programs import Capture

from uav_ident_ros.bags.reading import Bag, BagError
from uav_ident_ros.bags.salvage import SalvageReader
from uav_ident_ros.bags.writing import BagWriter, plain, qos
from uav_ident_ros.commandline import NOT_USABLE, USABLE
from uav_ident_ros.offline import NO_RESULT

SECONDS, MESSAGES = 6, 6 * 250 + 2
COMPRESSIONS = [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4]


def messages(path: Path) -> tuple[list[tuple[str, int, bytes]], list[str]]:
    """Return the messages of a bag, and its damage."""
    with Bag(path) as bag:
        return [tuple(m) for m in bag.messages([excerpts.IMU, excerpts.ACTUATORS])], bag.damage


def chunk_places(path: Path) -> list[tuple[int, int]]:
    """Return position and length of the chunks."""
    with path.open("rb") as file:
        indexes = make_reader(file).get_summary().chunk_indexes
    return [(c.chunk_start_offset, c.chunk_length) for c in indexes]


def spoil(path: Path, position: int, count: int = 40) -> None:
    content = bytearray(path.read_bytes())
    content[position : position + count] = bytes(b ^ 0xFF for b in content[position:][:count])
    path.write_bytes(content)


@pytest.fixture(scope="module", params=COMPRESSIONS, ids=lambda c: c.name.lower())
def flight(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an undamaged file of many chunks."""
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    return excerpts.rewritten(path, compression=request.param, seconds=SECONDS)


@pytest.fixture
def copy(flight: Path, tmp_path: Path) -> Path:
    """Return a copy of the short flight, for a test to damage."""
    target = tmp_path / "flight.mcap"
    target.write_bytes(flight.read_bytes())
    return target


def test_an_undamaged_file_is_read_in_full_and_in_order(flight: Path) -> None:
    found, damage = messages(flight)
    assert len(found) == MESSAGES
    assert damage == []
    reader = SalvageReader(flight)  # reads the same as rosbags, in the same order
    saved = [(c.topic, log_ns, data) for c, log_ns, data in reader.messages(reader.connections)]
    assert saved == found
    assert reader.damage == ""


def test_a_truncated_file_gives_all_messages_before_the_cut(flight: Path, copy: Path) -> None:
    whole, _ = messages(flight)
    places = chunk_places(flight)
    position, length = places[len(places) // 2]
    copy.write_bytes(flight.read_bytes()[: position + length * 2 // 3])
    found, (line,) = messages(copy)
    assert line.startswith("'flight.mcap' is cut off at its end; ")
    assert f"{len(found)} messages were saved" in line
    assert found == whole[: len(found)]
    # all complete chunks, and most of the last one
    before = len(places) // 2 / len(places) * len(whole)
    assert len(found) > before - 50
    if b"zstd" not in flight.read_bytes() and b"lz4" not in flight.read_bytes():
        assert len(found) > before + 0.6 * len(whole) / len(places)


@pytest.mark.parametrize("where", ["content", "length and content"])
def test_a_bad_chunk_is_omitted_and_the_rest_is_used(where: str, flight: Path, copy: Path) -> None:
    whole, _ = messages(flight)
    places = chunk_places(flight)
    position, length = places[len(places) // 3]
    spoil(copy, position + length // 2)
    if where != "content":  # then the record itself is unreadable
        spoil(copy, position + 1, 8)
    found, (line,) = messages(copy)
    kept = set(found)
    lost = [m for m in whole if m not in kept]
    assert found == [m for m in whole if m in kept]
    assert 0.5 * len(whole) / len(places) < len(lost) < 1.5 * len(whole) / len(places)
    if where != "content":
        assert line.startswith("'flight.mcap' cannot be read in 1 places between chunks; ")
        return
    assert line.startswith(f"'flight.mcap' is damaged: 1 of {len(places)} chunks are left out")
    begin, end = ((m[1] - whole[0][1]) * 1e-9 for m in (lost[0], lost[-1]))
    assert f"between {begin:.1f} s and {end:.1f} s after its start" in line


@pytest.mark.parametrize("index", [True, False])
def test_the_loss_in_a_chunk_without_checksum_is_counted(index: bool, tmp_path: Path) -> None:
    """A damaged record passes for one of another kind, and ends the chunk too soon."""
    path = excerpts.excerpt(tmp_path / "bag", 3.0) / "bag.mcap"
    whole, _ = messages(path)
    content = path.read_bytes()
    spoil(path, content.index(whole[len(whole) // 2][2]) - 31, 3)  # its kind and its length
    if not index:
        spoil(path, len(content) - 28, 8)
    found, (line,) = messages(path)
    assert set(found) < set(whole)
    assert line.startswith(f"'bag.mcap' lacks {len(whole) - len(found)} messages of its index; ")


def test_metadata_with_another_qos_hide_no_message(tmp_path: Path) -> None:
    path = excerpts.excerpt(tmp_path / "bag", 1.0)
    whole, _ = messages(path)
    with BagWriter(tmp_path / "other") as other:
        for topic, name in excerpts.TYPES.items():
            other.topic(topic, name, qos())
        for message in whole:
            other.write(*message)
    (tmp_path / "other" / "other.mcap").replace(path / "bag.mcap")
    assert messages(path) == (whole, [])


@pytest.mark.parametrize("profile", [False, True])
def test_a_bad_index_or_profile_loses_no_message(profile: bool, flight: Path, copy: Path) -> None:
    whole, _ = messages(flight)
    if profile:
        copy.write_bytes(copy.read_bytes().replace(b"ros2", b"xxxx", 1))
    else:
        spoil(copy, copy.stat().st_size - 28, 8)  # in the footer: the start of the index
    found, (line,) = messages(copy)
    assert found == whole
    assert line.endswith("yet all of it was read")
    assert ("Profile is not ros2" in line) == profile


@pytest.mark.parametrize("cut", [False, True])
def test_a_file_without_chunks_is_read_up_to_its_cut(cut: bool, tmp_path: Path) -> None:
    path = excerpts.rewritten(tmp_path / "flight.mcap", use_chunking=False, seconds=10.0)
    whole, damage = messages(path)
    assert (len(whole), damage) == (2502, [])
    if cut:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        found, (line,) = messages(path)
        assert found == whole[: len(found)]
        assert 1100 < len(found) < 1300
        assert "is cut off at its end" in line


def split(folder: Path, count: int, each: int, compress: bool = False) -> list[tuple]:
    """Write the start of a flight into several files of a folder; return its messages."""
    whole = messages(excerpts.BAGS / "multisine")[0][: count * each]
    bags = []
    for k in range(count):
        path, some = folder.parent / f"{folder.name}_{k}", whole[k * each : (k + 1) * each]
        bags.append(excerpts.written(path, excerpts.TYPES, some, compress=compress))
    excerpts.one_folder(folder, *bags)
    return whole


def test_a_bad_file_of_a_split_recording_is_omitted(tmp_path: Path) -> None:
    whole = split(tmp_path / "split", 3, 700)
    (tmp_path / "split" / "split_1.mcap").write_bytes(b"\0" * 5000)
    found, (line,) = messages(tmp_path / "split")
    assert "'split_1.mcap': " in line and "it is no MCAP file" in line
    assert found == [*whole[:700], *whole[1400:]]


@pytest.mark.parametrize("compress", [False, True])
def test_a_bad_chunk_in_one_of_two_files_is_omitted(compress: bool, tmp_path: Path) -> None:
    """The form is that of rosbag2: chunks of a megabyte, no checksums, unaffected metadata."""
    folder = tmp_path / "flight"
    whole = split(folder, 2, 6000, compress)
    text = (tmp_path / "flight_0" / "metadata.yaml").read_text()
    text = text.replace("- flight_0.mcap", "- flight_0.mcap\n  - flight_1.mcap", 1)
    (folder / "metadata.yaml").write_text(text)
    assert messages(folder) == (whole, [])
    file = folder / "flight_1.mcap"
    position, length = chunk_places(file)[0]
    spoil(file, position + length // 2, 2000)
    with Bag(folder) as bag:
        found = [tuple(m) for m in bag.messages(excerpts.TYPES)]
        assert [tuple(m) for m in bag.messages(excerpts.TYPES)] == found  # also when repeated
        (line,) = bag.damage
    assert found[:6000] == whole[:6000]
    assert found[-2000:] == whole[-2000:]
    assert len(found) < 12_000
    assert line.startswith("'flight_1.mcap' is damaged: 1 of ")


def test_a_file_without_a_readable_message_is_refused(flight: Path, copy: Path) -> None:
    copy.write_bytes(flight.read_bytes()[: chunk_places(flight)[0][0] + 20])
    with pytest.raises(BagError, match=r"cannot be read: 'flight\.mcap': .*no message to be saved"):
        Bag(copy)


def test_only_chunks_that_cannot_be_read(tmp_path: Path) -> None:
    """It is an MCAP file, and the message does not doubt it, but names the bag."""
    split(tmp_path / "split", 1, 700, compress=True)
    file = tmp_path / "split" / "split_0.mcap"
    for position, length in chunk_places(file):
        spoil(file, position + length // 2, 200)
    words = r"_0.mcap' is damaged: there is no message to be saved: it is damaged: 1 of 1 chunks"
    with pytest.raises(BagError, match=words):
        list(Bag(file).messages(excerpts.TYPES))


# --- replay ------------------------------------------------------------------------------------


def replayed(
    bag: Path, output: Path, *options: str, by: str | Path = "multisine"
) -> tuple[int, dict[str, Any]]:
    status = excerpts.replay(bag, output, *options, by=by)
    return status, excerpts.summary(output) if status != NO_RESULT else {}


def test_replay_of_a_damaged_bag_notes_the_damage_and_is_usable(
    warm: Path, tmp_path: Path, capsys: Capture
) -> None:
    damaged = excerpts.rewritten(tmp_path / "flight.mcap", seconds=12.0)
    position, length = chunk_places(damaged)[6]
    spoil(damaged, position + length // 2)
    status, summary = replayed(damaged, tmp_path / "out", by=warm)
    assert status == USABLE
    (note,) = summary["notes"]
    assert note.startswith("'flight.mcap' is damaged: 1 of ")
    assert f"note: {note[:60]}" in capsys.readouterr().out
    assert summary["ticks"] > 150
    assert summary["judged_ns"] == summary["last_tick_ns"]
    assert summary["coefficients"]["pdot/da"]["value"] == pytest.approx(60.0, rel=0.05)


def test_damage_is_printed_if_there_is_no_result(
    flight: Path, copy: Path, tmp_path: Path, capsys: Capture
) -> None:
    copy.write_bytes(flight.read_bytes()[: flight.stat().st_size // 2])
    status, _ = replayed(copy, tmp_path / "out", "--topic", "imu/data:=/gyro")
    assert status == NO_RESULT
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("replay: 'flight.mcap' is cut off at its end; ")
    assert "has no topic '/gyro'" in second


def test_actuators_shorter_than_the_imu_are_noted(warm: Path, tmp_path: Path) -> None:
    def some(topic: str, at: int, message: Any) -> list[excerpts.Entry]:
        there = 2.0 <= (at - excerpts.START_NS) * 1e-9 <= 9.0
        return [(topic, at, message)] if topic == excerpts.IMU or there else []

    bag = excerpts.excerpt(tmp_path / "bag", 12.0, change=some)
    status, summary = replayed(bag, tmp_path / "out", by=warm)
    assert status == USABLE
    assert summary["notes"] == [
        "the actuators start 2.0 s after the Imu: nothing is learned before",
        "the actuators stop 3.0 s before the Imu: nothing is learned after",
    ]
    # those that start after 7.2 s and end before 9.5 s: the last command holds for the timeout
    assert summary["prediction_fit"]["last_40_percent"]["windows"] == pytest.approx(26, abs=2)


@pytest.mark.parametrize(
    ("topic", "msgtype", "values", "reason", "within"),
    [
        ("armed", "std_msgs/msg/Bool", (True, False), "not armed", 0.2),
        # the estimator learns in batches of four ticks
        ("airspeed", "std_msgs/msg/Float64", (20.0, 2.0), "not flying: the airspeed is", 0.25),
    ],
)
def test_the_verdict_of_a_flight_holds_after_its_landing(
    topic: str, msgtype: str, values: tuple[float, float], reason: str, within: float,
    warm: Path, tmp_path: Path, capsys: Capture,
) -> None:  # fmt: skip
    landing_ns = excerpts.START_NS + 8 * excerpts.SECOND_NS

    def landed(name: str, at: int, message: Any) -> list[excerpts.Entry]:
        return [(name, at, message), (f"/{topic}", at, plain(msgtype, values[at >= landing_ns]))]

    also = excerpts.parameter_file(tmp_path / "params.yaml", **{f"{topic}.type": msgtype})
    bag = excerpts.excerpt(tmp_path / "bag", 11.0, change=landed)
    status, summary = replayed(bag, tmp_path / "out", "--params-file", str(also), by=warm)
    assert status == USABLE
    assert summary["state"] == "paused" and summary["reason"].startswith(reason)
    assert summary["judged_ns"] == pytest.approx(landing_ns, abs=within * excerpts.SECOND_NS)
    flown = (summary["judged_ns"] - summary["first_tick_ns"]) * 1e-9
    assert f"as of {flown:.1f} s: nothing was learned after" in capsys.readouterr().out


def test_a_fault_at_the_end_determines_the_verdict(warm: Path, tmp_path: Path) -> None:
    end_ns = excerpts.START_NS + 6 * excerpts.SECOND_NS

    def in_degrees(topic: str, at: int, message: Any) -> None:
        if topic == excerpts.IMU and at > end_ns:
            rate = message.angular_velocity
            rate.x, rate.y, rate.z = (math.degrees(value) for value in (rate.x, rate.y, rate.z))

    bag = excerpts.excerpt(tmp_path / "bag", 14.0, change=in_degrees)
    status, summary = replayed(bag, tmp_path / "out", by=warm)
    assert (status, summary["state"]) == (NOT_USABLE, "fault")
    assert summary["judged_ns"] == summary["last_tick_ns"]
    assert "deg" in summary["doubt"]


def test_an_actuator_topic_without_messages_is_noted(tmp_path: Path) -> None:
    whole, _ = messages(excerpts.BAGS / "multisine")
    rates = [message for message in whole[:800] if message[0] == excerpts.IMU]
    bag = excerpts.written(tmp_path / "silent", excerpts.TYPES, rates)
    status, summary = replayed(bag, tmp_path / "out")
    assert status == NOT_USABLE
    assert summary["notes"] == ["/actuators has no messages that could be used: nothing is learned"]


def test_a_channel_that_no_message_has_is_noted(tmp_path: Path) -> None:
    bag, channels = excerpts.excerpt(tmp_path / "bag", 2.0), ["elevator", "rudder", "thrust"]
    mixing = {f"actuators.mixing.{name}": [1.0, 0.0, 0.0] for name in ("de", "dr", "da", "dth")}
    values = {"actuators.channels": channels, **mixing}
    file = excerpts.parameter_file(tmp_path / "wrong.yaml", **values)
    assert excerpts.replay(bag, tmp_path / "out", by=file) == NOT_USABLE
    (note,) = excerpts.summary(tmp_path / "out")["notes"]
    assert "could be used: there is no channel 'thrust' among elevator, rudder, aileron," in note


def test_of_two_imu_topics_the_one_with_the_default_name_is_read(tmp_path: Path) -> None:
    def doubled(topic: str, at: int, message: Any) -> list[excerpts.Entry]:
        return [(topic, at, message)] + ([("/imu_2", at, message)] if topic == excerpts.IMU else [])

    bag = excerpts.excerpt(tmp_path / "bag", 3.0, change=doubled)
    _, summary = replayed(bag, tmp_path / "out")
    assert summary["inputs"]["rates"]["topic"] == excerpts.IMU
    assert summary["notes"] == [
        "/imu/data was read; the bag also has /imu_2: --topic imu/data:=/imu_2 reads that instead"
    ]


def test_two_imus_on_one_topic_are_noted(tmp_path: Path) -> None:
    def mixed(topic: str, at: int, message: Any) -> None:
        if topic == excerpts.IMU and at % 20_000_000 == 0:
            message.header.frame_id = "imu_2"

    _, summary = replayed(excerpts.excerpt(tmp_path / "bag", 3.0, change=mixed), tmp_path / "out")
    (note,) = summary["notes"]
    assert note.startswith("/imu/data has messages of several frames, '")
    assert "'imu_2'" in note


def test_messages_that_cannot_be_decoded_are_counted(tmp_path: Path) -> None:
    """The first message of each topic is empty; some others are truncated."""
    whole, _ = messages(excerpts.excerpt(tmp_path / "whole", 3.0))
    spoiled = [(topic, whole[0][1], b"") for topic in excerpts.TYPES]
    for count, (topic, log_ns, data) in enumerate(whole):
        spoiled.append((topic, log_ns, data[:30] if count % 100 == 7 else data))
    bag = excerpts.written(tmp_path / "bag", excerpts.TYPES, spoiled)
    _, summary = replayed(bag, tmp_path / "out")
    dropped = [summary["inputs"][s]["dropped"]["not decodable"] for s in ("rates", "actuators")]
    assert min(dropped) >= 1
    assert sum(dropped) == 8 + 2
    assert summary["ticks"] > 50
