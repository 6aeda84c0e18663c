# SPDX-License-Identifier: Apache-2.0
"""Damaged, foreign and incomplete files: one line that names the file and what is there."""

from __future__ import annotations

import io
import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from dataflash_writing import DataflashWriter
from imported import contents, refusal, run
from programs import python
from pyulog import ULog
from ulog_writing import commands, sensor_combined, stamps, write_ulog

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.import_logs.cli import DAMAGED
from uav_ident_ros.import_logs.dataflash import HEADER, read_dataflash
from uav_ident_ros.import_logs.flight_log import Findings
from uav_ident_ros.import_logs.px4_log import MAGIC, SYNC, read_ulog, title_of

IMU_NS = 5_000_000 * np.arange(1, 2001)
VALUES = np.random.default_rng(1).normal(size=(len(IMU_NS), 3))
COMMANDS = commands(IMU_NS[::4], VALUES[::4], "xyz")
RATES = sensor_combined(IMU_NS, VALUES, VALUES)
GOOD = {("sensor_combined", 0): RATES, ("vehicle_torque_setpoint", 0): COMMANDS}


@pytest.fixture
def out(tmp_path: Path) -> list[str]:
    return ["--output", str(tmp_path / "bag")]


def plane_log(tmp_path: Path, *left_out: str) -> Path:
    writer = DataflashWriter(tmp_path)
    writer.add_parameters({"SERVO1_FUNCTION": 4, "SERVO2_FUNCTION": 19})
    rows = [(int(t) // 1000, "IMU", (0, *v, *v)) for t, v in zip(IMU_NS, VALUES, strict=True)]
    rows += [(int(t) // 1000, "RCOU", (1500, 1500 + i % 9)) for i, t in enumerate(IMU_NS[::4])]
    writer.add_rows([row for row in rows if row[1] not in left_out])
    return writer.write(tmp_path / "plane.bin")


def ulog(tmp_path: Path, *left_out: str) -> Path:
    topics = {key: columns for key, columns in GOOD.items() if key[0] not in left_out}
    return write_ulog(tmp_path / "good.ulg", topics, {})


KINDS = pytest.mark.parametrize("write", [ulog, plane_log])


def spoilt(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    return str(path)


# --- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("nowhere.ulg", None, "nowhere.ulg' cannot be read: No such file"),
        ("", None, "has no table of ulog2csv, as LOG_sensor_combined_0.csv"),
        ("flight.ulg", b"", "flight.ulg' is empty"),
        ("flight.bin", b"", "flight.bin' is empty"),
        ("flight.csv", b"", "flight.csv' is empty"),
        ("flight.ulg", bytes(range(256)) * 40, "of no known kind"),
        ("flight.bin", bytes(range(256)) * 40, "of no known kind"),
        ("short.ulg", MAGIC + b"\1" + bytes(2), "short.ulg' is no readable ULog file"),
        ("short.ulg", MAGIC + b"\1" + bytes(8), "it has no messages at all"),
    ],
)
def test_files_that_are_no_log(tmp_path: Path, capsys, out, name: str, content, words) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert words in refusal([str(tmp_path / name), *out], capsys)


def test_what_is_no_file_on_a_disk(tmp_path: Path, capsys, out) -> None:
    os.mkfifo(tmp_path / "pipe.bin")
    for name in (str(tmp_path / "pipe.bin"), "/dev/zero"):
        assert f"'{name}' is no regular file" in refusal([name, *out], capsys)


def test_nothing_half_written_stays_behind(tmp_path: Path, capsys, out) -> None:
    """A limit on the size of files fails the writing in the middle of the bag."""
    log = ulog(tmp_path)
    program = (
        "import resource, signal, sys\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "from uav_ident_ros.import_logs.cli import main\n"
        f"sys.exit(main({[str(log), *out]!r}))"
    )
    done = python("-c", program)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("import_log: cannot write")
    assert not (tmp_path / "bag").exists()


def test_the_output_is_not_overwritten(tmp_path: Path, capsys, out) -> None:
    (tmp_path / "bag").mkdir()
    log = ulog(tmp_path)
    assert "exists already" in refusal([str(log), *out], capsys)
    assert not list((tmp_path / "bag").iterdir())


# --- both kinds ---------------------------------------------------------------------------------


@KINDS
def test_a_log_that_is_cut_off_gives_what_is_there(tmp_path: Path, capsys, out, write) -> None:
    whole = write(tmp_path).read_bytes()
    cut = spoilt(write(tmp_path), whole[: len(whole) // 2 + 5])
    assert "cut off at its end" in run([cut, *out], capsys)
    found = contents(tmp_path / "bag")
    np.testing.assert_array_equal(found.imu_t_ns, IMU_NS[: len(found.imu_t_ns)])
    assert 700 < len(found.imu_t_ns) < 1300


@KINDS
def test_a_whole_log_is_not_called_damaged(tmp_path: Path, capsys, out, write) -> None:
    said = run([str(write(tmp_path)), *out], capsys)
    assert "cut off" not in said
    assert "damaged" not in said


@KINDS
def test_a_log_with_garbage_inside_says_so(tmp_path: Path, capsys, out, write) -> None:
    path = write(tmp_path)
    whole = bytearray(path.read_bytes())
    middle = len(whole) // 2
    whole[middle : middle + 1000] = np.random.default_rng(5).bytes(1000)
    said = run([spoilt(path, whole), *out], capsys, DAMAGED)
    (lost,) = re.findall(r"the file is damaged: (\d+) of \d+ bytes \(.* %\) in 1 place", said)
    assert 900 < int(lost) < 1200  # not to the next sync, of which there is none here
    assert len(contents(tmp_path / "bag").imu_t_ns) > len(IMU_NS) - 40
    assert "# Damaged:" in (tmp_path / "bag" / "identifier.yaml").read_text()


@pytest.mark.parametrize(
    ("write", "left_out", "said"),
    [
        (ulog, "sensor_combined", "has no rates .*it has vehicle_torque_setpoint"),
        (ulog, "vehicle_torque_setpoint", "has no actuators .*it has sensor_combined"),
        (plane_log, "IMU", "has no rates .*it has .*PARM"),
        (plane_log, "RCOU", "has no actuators .*it has .*PARM"),
    ],
)
def test_a_log_without_one_of_both(tmp_path: Path, capsys, out, write, left_out, said) -> None:
    assert re.search(said, refusal([str(write(tmp_path, left_out)), *out], capsys))


# --- ULog ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["size", "type", "topic", "stamp"])
def test_one_damaged_byte_of_a_ulog_costs_one_sample(
    tmp_path: Path, capsys, out, part: str
) -> None:
    path = ulog(tmp_path)
    whole = bytearray(path.read_bytes())
    size = struct.calcsize("<Q3fIi3f") + 5
    header = (size - 3).to_bytes(2, "little") + b"D\0\0"
    place = whole.index(header, len(whole) // 2)
    at, value = {"size": (0, 9), "type": (2, 0), "topic": (3, 1), "stamp": (11, 0x55)}[part]
    whole[place + at] = value
    said = run([spoilt(path, whole), *out], capsys, DAMAGED)
    found = contents(tmp_path / "bag")
    assert len(found.imu_t_ns) == len(IMU_NS) - 1
    assert set(found.imu_t_ns) < set(IMU_NS)
    assert len(found.actuator_t_ns) == len(IMU_NS) // 4
    if part != "stamp":
        assert f"{size} of {len(whole)} bytes (" in said
        assert "in 1 place, about 0.0" in said


def test_a_ulog_reads_as_pyulog_reads_it(tmp_path: Path) -> None:
    """An undamaged one, that is: nested formats, array fields, padding, facts, parameters."""
    inner = "vec:float x;float[2] yz;"
    outer = "nested:uint64_t timestamp;vec[2] arms;int8_t level;char[3] name;uint8_t[5] _padding0;"
    rows = [struct.pack("<Q6fb3s", 1000 * i, *range(i, i + 6), -i % 99, b"abc") for i in range(9)]
    written = io.BytesIO()
    written.write(MAGIC + b"\1" + struct.pack("<Q", 77))
    facts = [
        ("char[3] sys_name", b"PX4"),
        ("uint32_t ver_sw_release", struct.pack("<I", 0x10C0000)),
    ]
    values = [("float GAIN", struct.pack("<f", 0.1)), ("int32_t COUNT", struct.pack("<i", -4))]
    messages = [("B", bytes(40)), ("F", inner.encode()), ("F", outer.encode())]
    messages += [("I", bytes([len(key)]) + key.encode() + value) for key, value in facts]
    messages += [("P", bytes([len(key)]) + key.encode() + value) for key, value in values]
    messages += [("A", b"\2\7\0nested"), *(("D", b"\7\0" + row) for row in rows[:5])]
    messages += [("S", SYNC), ("O", b"\x0a\0"), ("L", b"6" + bytes(8) + b"take-off")]
    messages += [("P", bytes([10]) + b"float GAIN" + struct.pack("<f", 0.5))]
    messages += [("D", b"\7\0" + row) for row in rows[5:]]
    for kind, content in messages:
        written.write(struct.pack("<HB", len(content), ord(kind)) + content)
    path = tmp_path / "nested.ulg"
    path.write_bytes(written.getvalue())
    ours, theirs = read_ulog(path), ULog(str(path))
    assert ours.findings == Findings(
        lost=["the logger lost messages 1 times, together 0.01 s, at most 0.01 s (dropouts)"]
    )
    (topic,) = theirs.data_list
    assert (topic.name, topic.multi_id) == ("nested", 2)
    for name, values in topic.data.items():
        np.testing.assert_array_equal(
            ours.messages("nested", 2).columns[name], values, err_msg=name
        )
    assert ours.messages("nested", 2).size("arms[1].yz") == 2
    assert ours.parameters == theirs.initial_parameters
    assert ours.changes == [(0.004, "GAIN", 0.5)]
    assert ours.dropouts == [0.01]
    assert title_of(ours) == "PX4 v1.12.0"
    assert ours.end_ns == theirs.last_timestamp * 1000


@pytest.mark.parametrize(
    "formats",
    [
        ["a:uint64_t timestamp;b[65535] x;", "b:c[65535] y;", "c:uint64_t[65535] z;"],
        ["a:uint64_t timestamp;a again;"],
        ["a:uint64_t timestamp;b[65535] x;", "b:c[65535] y;", "c:"],
        ["a:uint64_t timestamp;uint64_t timestamp;"],
    ],
)
def test_formats_of_endless_size(tmp_path: Path, capsys, out, formats: list[str]) -> None:
    content = MAGIC + b"\1" + bytes(8)
    for kind, text in [*(("F", f.encode()) for f in formats), ("A", b"\0\0\0a")]:
        content += struct.pack("<HB", len(text), ord(kind)) + text
    (tmp_path / "bomb.ulg").write_bytes(content)
    assert "it has no messages at all" in refusal([str(tmp_path / "bomb.ulg"), *out], capsys)


def test_a_ulog_with_a_stamp_that_no_clock_gave(tmp_path: Path, capsys, out) -> None:
    topics = {key: {n: v.copy() for n, v in columns.items()} for key, columns in GOOD.items()}
    topics["sensor_combined", 0]["timestamp"][1000] = 2**62
    topics["vehicle_torque_setpoint", 0]["timestamp"][200] = 2**63
    log = write_ulog(tmp_path / "flight.ulg", topics, {})
    said = run([str(log), *out], capsys, DAMAGED)
    assert "1 of 2000 messages sensor_combined have a stamp that no clock gave" in said
    assert "1 of 500 messages vehicle_torque_setpoint have a stamp that no clock gave" in said
    found = contents(tmp_path / "bag")
    np.testing.assert_array_equal(found.imu_t_ns, np.delete(IMU_NS, 1000))
    assert found.log_ns[-1] == IMU_NS[-1]


def test_a_last_stamp_that_lies_days_ahead(tmp_path: Path, capsys, out) -> None:
    """It may be a straggler; what is written for every second is not written for those days."""
    rates = {name: values.copy() for name, values in RATES.items()}
    rates["timestamp"][-1] += 5 * 86_400_000_000
    armed = {"timestamp": stamps(IMU_NS[:2]), "arming_state": np.full(2, 2, np.uint8)}
    topics = GOOD | {("sensor_combined", 0): rates, ("vehicle_status", 0): armed}
    log = write_ulog(tmp_path / "flight.ulg", topics, {})
    assert "armed for 43" in run([str(log), *out], capsys)
    with Bag(tmp_path / "bag") as bag:
        assert bag.counts["/armed"] < 15


def test_topics_that_are_none(tmp_path: Path, capsys, out) -> None:
    log = str(ulog(tmp_path))
    for option, name, said in (
        ("rates", "sensor_mag", "there are sensor_combined, sensor_gyro, vehicle_angular_velocity"),
        ("actuators", "servos", "actuator_motors"),
        ("actuators", "actuator_controls_0", "has no actuators (actuator_controls_0)"),
    ):
        assert said in refusal([log, f"--{option}-topic", name, *out], capsys)
    assert "has no airspeed" in refusal([log, "--airspeed", *out], capsys)


def test_motors_without_geometry_are_refused_on_request_and_passed_over_else(
    tmp_path: Path, capsys, out
) -> None:
    topics = GOOD | {("actuator_motors", 0): commands(IMU_NS[::4], VALUES[::4], "control")}
    log = str(write_ulog(tmp_path / "good.ulg", topics, {}))
    said = refusal([log, "--actuators-topic", "actuator_motors", *out], capsys)
    assert "no parameter (CA_ROTOR*, CA_SV_CS*)" in said
    assert "actuators: vehicle_torque_setpoint" in run([log, *out], capsys)


def test_motors_that_were_never_on(tmp_path: Path, capsys, out) -> None:
    nothing = np.full((len(IMU_NS) // 4, 12), np.nan)
    motors = {("actuator_motors", 0): commands(IMU_NS[::4], nothing, "control")}
    topics = {("sensor_combined", 0): RATES} | motors
    log = write_ulog(tmp_path / "good.ulg", topics, {"CA_ROTOR_COUNT": 4, "CA_AIRFRAME": 0})
    assert "hold no value throughout" in refusal([str(log), *out], capsys)


# --- dataflash ----------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["header", "type", "known type", "stamp"])
def test_one_damaged_byte_of_a_bin_costs_one_message(
    tmp_path: Path, capsys, out, part: str
) -> None:
    """pymavlink's index stops at it, and with it went the rest of the log."""
    whole = bytearray(plane_log(tmp_path).read_bytes())
    reader = read_dataflash(tmp_path / "plane.bin", ("IMU", "RCOU"))
    assert reader.messages("IMU").stamp_ns.tolist() == IMU_NS.tolist()
    kind = whole[whole.index(b"IMU\0") - 2]
    pattern = HEADER + bytes([kind])
    place = whole.index(pattern, len(whole) // 2)
    at, value = {
        "header": (0, 0),
        "type": (2, 0),
        "known type": (2, whole[whole.index(b"RCOU") - 2]),
        "stamp": (9, 0x55),
    }[part]
    whole[place + at] = value
    said = run([spoilt(tmp_path / "plane.bin", whole), *out], capsys, DAMAGED)
    found = contents(tmp_path / "bag")
    assert len(found.imu_t_ns) == len(IMU_NS) - 1
    assert set(found.imu_t_ns) < set(IMU_NS)
    assert len(found.actuator_t_ns) == len(IMU_NS) // 4
    if part == "stamp":
        assert "1 of 2000 messages IMU have a stamp that no clock gave" in said
    else:
        size = struct.calcsize("<3xQBffffffIIfBBHH")
        assert f"{size} of {len(whole)} bytes (" in said
        assert re.search("in 1 place, about 0.0(05|1) s of the log", said)


def test_a_dataflash_log_reads_as_pymavlink_reads_it(tmp_path: Path) -> None:
    """An undamaged one, that is: its reader is the reference for fields and units."""
    from pymavlink.DFReader import DFReader_binary

    writer = DataflashWriter(tmp_path)
    writer.add_parameters({"SERVO1_FUNCTION": 4, "INS_POS1_X": 0.1})
    numbers = np.random.default_rng(3)
    for t in range(50):
        writer.add("IMU", 1000 * t, t % 2, *numbers.normal(size=6))
        writer.add("ARSP", 1000 * t, 0, *numbers.normal(size=2), 1234)
        writer.add("CTUN", 1000 * t, *numbers.integers(-9000, 9000, 4), *numbers.normal(size=6))
    path = writer.write(tmp_path / "flight.bin")
    log = read_dataflash(path, ("IMU", "ARSP", "CTUN"))
    theirs: dict[str, list] = {}
    reader = DFReader_binary(str(path), zero_time_base=True)
    while (message := reader.recv_msg()) is not None:
        theirs.setdefault(message.get_type(), []).append(message)
    reader.close()
    assert log.parameters == {m.Name: m.Value for m in theirs["PARM"]}
    for name, count in (("IMU", 2), ("ARSP", 1), ("CTUN", 1)):
        assert log.instances(name) == list(range(count))
        for instance in range(count):
            ours = log.messages(name, instance)
            wanted = [m for m in theirs[name] if getattr(m, "I", 0) == instance]
            for field in wanted[0].get_fieldnames():
                values = [getattr(m, field) for m in wanted]
                np.testing.assert_array_equal(ours.columns[field], values, err_msg=field)


def test_outputs_without_functions(tmp_path: Path, capsys, out) -> None:
    writer = DataflashWriter(tmp_path)
    writer.add_rows(
        [(int(t) // 1000, "IMU", (0, *v, *v)) for t, v in zip(IMU_NS, VALUES, strict=True)]
        + [(int(t) // 1000, "RCOU", (1500, 1500)) for t in IMU_NS[::4]]
    )
    said = refusal([str(writer.write(tmp_path / "flight.bin")), *out], capsys)
    assert "no SERVOn_FUNCTION names a surface or a motor" in said


# --- tables -------------------------------------------------------------------------------------

COLUMNS = """\
time: {column: t}
axes: frd
rates: {columns: [p, q, r], unit: rad/s}
channels:
  elevator: {column: de, de: 1.0}
"""
TABLE = "t,p,q,r,de\n" + "".join(f"{0.01 * i:.2f},0.1,0.2,0.3,{0.01 * i}\n" for i in range(300))


def table(tmp_path: Path, text: str = TABLE, columns: str = COLUMNS) -> list[str]:
    (tmp_path / "flight.csv").write_text(text, encoding="utf-8")
    (tmp_path / "columns.yaml").write_text(columns, encoding="utf-8")
    return [str(tmp_path / "flight.csv"), "--columns", str(tmp_path / "columns.yaml")]


def test_a_table_without_a_map(tmp_path: Path, capsys, out) -> None:
    said = refusal([table(tmp_path)[0], *out], capsys)
    assert "--columns FILE" in said
    assert "t,p,q,r,de" in said


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (TABLE.replace("t,p,q,r,de", "t,p,q,r,elevator"), "no column 'de'; it has t, p, q, r"),
        (TABLE.replace("t,p,q,r,de", "t,p,q,R,de"), "no column 'r'"),
        (TABLE.replace("1.00,0.1", "1.00,fast"), "line 102: 'fast' is no number"),
        (TABLE.replace("1.00,0.1", "noon,0.1"), "line 102: the time is 'noon'"),
        (TABLE.replace("1.00,0.1", "-1.0,0.1"), "line 102: the time is '-1.0': a stamp holds 0 to"),
        (TABLE.replace("1.00,0.1", "1e300,0.1"), "line 102: the time is '1e300': a stamp holds"),
        (TABLE.replace("1.00,0.1", "inf,0.1"), "line 102: the time is 'inf'"),
        (TABLE.replace("1.00,0.1", "nan,0.1"), "line 102: the time is 'nan', which is no number"),
        (TABLE[:11] + "".join(reversed(TABLE[11:].splitlines(True))), "goes on in 0 rows and back"),
        (re.sub(r"(?m)^[0-9.]+", "3.0", TABLE), "goes on in 0 rows and back in 0: sort the rows"),
        ("t,p,q,r,de\n", "no complete row"),
        ("t,p,q,r,de\n1.0,,,,0.5\n", "has no rates: columns p, q, r are empty"),
        ("t,p,q,r,de\n1.0,1,2,3,\n", "has no actuators: columns de are empty"),
        ("# nothing\n\n", "is empty: a header line is needed"),
    ],
)
def test_tables_that_cannot_be_used(tmp_path: Path, capsys, out, text: str, reason: str) -> None:
    said = refusal([*table(tmp_path, text), *out], capsys)
    assert "flight.csv'" in said
    assert reason in said


def test_counts_of_a_raw_sensor(tmp_path: Path, capsys, out) -> None:
    units = COLUMNS.replace("unit: rad/s}", "unit: deg/s, counts: 16.4}")
    units += "specific_force: {columns: [q, r, p], unit: g, counts: 2048}\n"
    run([*table(tmp_path, columns=units), *out], capsys)
    found = contents(tmp_path / "bag")
    np.testing.assert_allclose(found.rates[0], np.radians([0.1, 0.2, 0.3]) / 16.4, rtol=1e-12)
    np.testing.assert_allclose(
        found.force[0], 9.80665 * np.array([0.2, 0.3, 0.1]) / 2048, rtol=1e-12
    )


def test_a_table_that_is_cut_off_gives_what_is_there(tmp_path: Path, capsys, out) -> None:
    said = run([*table(tmp_path, TABLE[:-12]), *out], capsys)
    assert "1 rows have too few cells and were left out, the first in line 301" in said
    assert len(contents(tmp_path / "bag").imu_t_ns) == 299


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("time:", "tyme:"), "unknown entry 'tyme': did you mean 'time'?"),
        (("unit: rad/s", "unit: rpm"), "rates.unit is 'rpm': allowed are rad/s, deg/s"),
        ((", unit: rad/s", ""), "rates.unit is missing"),
        (("rad/s}", "deg/s, counts: 0}"), "rates.counts is 0: how many counts make up one unit"),
        (("axes: frd\n", ""), "the file has no axes"),
        (("[p, q, r]", "[p, q]"), "three columns x, y, z are needed"),
        (("de: 1.0", "de: up"), "channels.elevator.de is 'up': a finite number is needed"),
        ((", de: 1.0", ""), "no channel says what it moves"),
        (("de: 1.0", "dq: 1.0"), "channels.elevator has an unknown entry 'dq'"),
        (("time: {column: t}", "time: {"), "is no YAML"),
    ],
)
def test_maps_that_cannot_be_used(tmp_path: Path, capsys, out, change, reason: str) -> None:
    said = refusal([*table(tmp_path, columns=COLUMNS.replace(*change)), *out], capsys)
    assert "columns.yaml'" in said
    assert reason in said


def test_the_example_of_the_help_is_a_good_map(tmp_path: Path) -> None:
    from uav_ident_ros.import_logs.column_map import EXAMPLE, load_column_map

    (tmp_path / "columns.yaml").write_text(EXAMPLE, encoding="utf-8")
    assert load_column_map(tmp_path / "columns.yaml").airspeed.columns == ("tas",)
