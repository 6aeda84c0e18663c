# SPDX-License-Identifier: Apache-2.0
"""Damaged, foreign and incomplete files: a one-line error with the file and its problem."""

import os
import re
import struct
import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blackbox_writing import FIELDS, blackbox
from dataflash_writing import Rows, write_dataflash
from excerpts import BAGS
from good_logs import (
    ARMED,
    COLUMNS,
    GOOD,
    IMU_NS,
    RATES,
    TABLE,
    VALUES,
    plane_log,
    table,
    ulog,
    written,
)  # fmt: skip
from imported import Importer
from programs import python
from pyulog import ULog
from ulog_writing import commands, keyed, message, stamps, write_ulog

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.import_logs.cli import DAMAGED
from uav_ident_ros.import_logs.dataflash import SYNC, read_dataflash
from uav_ident_ros.import_logs.log import Findings
from uav_ident_ros.import_logs.px4_log import MAGIC, read_ulog
from uav_ident_ros.import_logs.stamps import NS_PER_S, plausible

Make = Callable[[Path], list[str]]
"""Function that writes a log into a folder and returns the arguments of its import."""


KINDS = pytest.mark.parametrize("write", [ulog, plane_log])


def test_a_failed_write_leaves_no_bag(tmp_path: Path) -> None:
    """A limit on the file size stops the writing in the middle of the bag."""
    program = (
        "import resource, signal, sys\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "from uav_ident_ros.import_logs.cli import main\n"
        f"sys.exit(main({[str(ulog(tmp_path)), '--output', str(tmp_path / 'bag')]!r}))"
    )
    done = python("-c", program)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("import_log: cannot write")
    assert not (tmp_path / "bag").exists()


def test_the_output_is_not_overwritten(importer: Importer) -> None:
    (importer.folder / "refused").mkdir()
    assert "exists already" in importer.refused(ulog(importer.folder))
    assert not list((importer.folder / "refused").iterdir())


@pytest.mark.parametrize(
    ("library", "extra", "content"),
    [("orangebox", "blackbox", blackbox(50)), ("pyulog", "import_log", MAGIC + bytes(9))],
)
def test_the_error_of_a_missing_library_names_the_extra(
    importer: Importer, monkeypatch: pytest.MonkeyPatch, library: str, extra: str, content: bytes
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    line = importer.refused(written(importer.folder / "log", content))
    assert f"{library} is not installed" in line
    assert f"uav_ident_ros[{extra}]" in line


# --- both kinds ---------------------------------------------------------------------------------


@KINDS
def test_a_truncated_log_gives_the_samples_before_the_cut(importer: Importer, write: Any) -> None:
    path = write(importer.folder)
    whole = path.read_bytes()
    found, _, printed = importer(written(path, whole[: len(whole) // 2 + 5]))
    assert "cut off at its end" in printed
    np.testing.assert_array_equal(found.imu_t_ns, IMU_NS[: len(found.imu_t_ns)])
    assert 700 < len(found.imu_t_ns) < 1300


@KINDS
def test_garbage_inside_a_log_is_reported(importer: Importer, write: Any) -> None:
    path = write(importer.folder)
    whole = bytearray(path.read_bytes())
    middle = len(whole) // 2
    whole[middle : middle + 1000] = np.random.default_rng(5).bytes(1000)
    it = importer(written(path, whole), status=DAMAGED)
    (lost,) = re.findall(r"the file is damaged: (\d+) of \d+ bytes \(.* %\) in 1 place", it.printed)
    assert 900 < int(lost) < 1200  # this part has no further sync mark
    assert len(it.bag.imu_t_ns) > len(IMU_NS) - 40
    assert "# Damaged:" in (it.folder / "identifier.yaml").read_text()


@pytest.mark.parametrize(
    ("write", "part", "at", "value"),
    [
        (ulog, "size", 0, 9), (ulog, "type", 2, 0), (ulog, "topic", 3, 1),
        (ulog, "stamp", 11, 0x55), (plane_log, "header", 0, 0), (plane_log, "type", 2, 0),
        (plane_log, "known type", 2, 0), (plane_log, "stamp", 9, 0x55),
    ],
)  # fmt: skip
def test_one_damaged_byte_costs_one_sample(
    importer: Importer, write: Any, part: str, at: int, value: int
) -> None:
    """A library's reader may lose synchronisation there, and much of the log with it."""
    path = write(importer.folder)
    whole = bytearray(path.read_bytes())
    if write is ulog:
        size = struct.calcsize("<Q3fIi3f") + 5
        header = (size - 3).to_bytes(2, "little") + b"D\0\0"
    else:
        size = struct.calcsize("<3xQBffffffIIfBBHH")
        header = SYNC + whole[whole.index(b"IMU\0") - 2 :][:1]
        value = whole[whole.index(b"RCOU") - 2] if part == "known type" else value
    whole[whole.index(header, len(whole) // 2) + at] = value
    found, _, printed = importer(written(path, whole), status=DAMAGED)
    assert len(found.imu_t_ns) == len(IMU_NS) - 1
    assert set(found.imu_t_ns) < set(IMU_NS)
    assert len(found.actuator_t_ns) == len(IMU_NS) // 4
    if part != "stamp":
        assert f"{size} of {len(whole)} bytes (" in printed
        assert "in 1 place, about 0.0" in printed
    else:
        kind = "sensor_combined" if write is ulog else "IMU"
        assert f"1 of 2000 samples of {kind} have an implausible stamp" in printed


# --- ULog ---------------------------------------------------------------------------------------


def test_a_ulog_reads_as_pyulog_reads_it(tmp_path: Path) -> None:
    """The log is undamaged: nested formats, array fields, padding, information, parameters."""
    inner = "vec:float x;float[2] yz;"
    outer = "nested:uint64_t timestamp;vec[2] arms;int8_t level;char[3] name;uint8_t[5] _padding0;"
    rows = [struct.pack("<Q6fb3s", 1000 * i, *range(i, i + 6), -i % 99, b"abc") for i in range(9)]
    data = [message("D", b"\7\0" + row) for row in rows]
    parts = [MAGIC + b"\1" + struct.pack("<Q", 77), message("B", bytes(40))]
    parts += [message("F", inner.encode()), message("F", outer.encode())]
    parts += [keyed("I", "char[3] sys_name", b"PX4")]
    parts += [keyed("I", "uint32_t ver_sw_release", struct.pack("<I", 0x10C0000))]
    parts += [keyed("P", "float GAIN", struct.pack("<f", 0.1))]
    parts += [keyed("P", "int32_t COUNT", struct.pack("<i", -4))]
    parts += [message("A", b"\2\7\0nested"), *data[:5], message("O", b"\x0a\0")]
    parts += [message("S", b"\x2f\x73\x13\x20\x25\x0c\xbb\x12")]
    parts += [message("L", b"6" + bytes(8) + b"take-off")]
    parts += [keyed("P", "float GAIN", struct.pack("<f", 0.5)), *data[5:]]
    path = written(tmp_path / "nested.ulg", b"".join(parts))
    ours, theirs = read_ulog(path, {"nested"}), ULog(str(path))
    assert ours.findings == Findings(
        lost=["the logger lost messages 1 times, together 0.01 s, at most 0.01 s (dropouts)"]
    )
    columns = ours.messages("nested", 2).columns
    for name, values in theirs.data_list[0].data.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)
    assert ours.messages("nested", 2).array("arms[1].yz").shape == (9, 2)
    assert ours.parameters == theirs.initial_parameters
    assert ours.changes == [(0.004, "GAIN", 0.5)]
    assert ours.title == "PX4 v1.12.0"
    assert ours.end_ns == theirs.last_timestamp * 1000


def test_a_last_stamp_days_ahead_adds_few_armed_messages(importer: Importer) -> None:
    """The stamp may be an outlier: messages repeated every second stop before it."""
    rates = deepcopy(RATES)
    rates["timestamp"][-1] += 5 * 86_400_000_000
    topics = GOOD | ARMED | {("sensor_combined", 0): rates}
    it = importer(write_ulog(importer.folder / "flight.ulg", topics, {}))
    assert "armed for 43" in it.printed
    with Bag(it.folder) as bag:
        assert bag.counts["/armed"] < 15


# --- dataflash ----------------------------------------------------------------------------------


def test_a_dataflash_log_reads_as_pymavlink_reads_it(tmp_path: Path) -> None:
    """The log is undamaged: pymavlink is the reference for fields and units."""
    from pymavlink.DFReader import DFReader_binary

    numbers = np.random.default_rng(3)
    rows: Rows = []
    for t in range(50):
        rows.append((1000 * t, "IMU", (t % 2, *numbers.normal(size=6))))
        rows.append((1000 * t, "ARSP", (0, *numbers.normal(size=2), 1234)))
        angles = numbers.integers(-9000, 9000, 4)
        rows.append((1000 * t, "CTUN", (*angles, *numbers.normal(size=6))))
    values = {"SERVO1_FUNCTION": 4, "INS_POS1_X": 0.1}
    path = write_dataflash(tmp_path / "flight.bin", rows, values)
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


# --- tables -------------------------------------------------------------------------------------


def test_a_table_with_a_truncated_row_gives_all_other_rows(importer: Importer) -> None:
    found, _, printed = importer(
        *table(importer.folder, TABLE[:-12] + "\n2.90,0.1,0.2,0.3,2.9\n"), status=DAMAGED
    )
    assert "1 rows have too few cells and were left out, the first in line 301" in printed
    assert "rates: 1 stamps are earlier than the one before" in printed
    assert len(found.imu_t_ns) == 300


@pytest.mark.parametrize(
    ("weights", "structure"), [("de: 1.0", None), ("dr: 0.5, dth: 0.5", None),
    ("de: -0.5, dth: 0.25", "augmented"), ("da: 0.5, dth: 0.25", "augmented")]
)  # fmt: skip
def test_channels_that_lift_and_roll_or_pitch_are_a_multirotors(
    importer: Importer, weights: str, structure: str | None
) -> None:
    columns = COLUMNS.replace("de: 1.0", weights)
    columns += "specific_force: {columns: [p, q, r], unit: m/s^2}\n"
    _, values, printed = importer(*table(importer.folder, columns=columns))
    assert values.get("structure") == structure
    assert ("For a multirotor set 'structure' to 'augmented'" in printed) == (structure is None)
    assert ("set airspeed.reference to the usual airspeed" in printed) == (structure is None)


def test_unused_columns_may_share_a_name(importer: Importer) -> None:
    text = TABLE.replace("r,de", "r,note,,note,,de").replace("0.3,", "0.3,5,,6,,")
    found = importer(*table(importer.folder, text)).bag
    np.testing.assert_allclose(found.actuators[:, 0], 0.01 * np.arange(300))


def test_the_command_that_follows_quotes_a_path_with_blanks(importer: Importer) -> None:
    importer.folder = importer.folder / "first flight"
    importer.folder.mkdir()
    printed = importer(*table(importer.folder)).printed
    bag = importer.folder / "bag_1"
    assert f"; next: replay '{bag}' --params-file '{bag}/identifier.yaml'" in printed


def test_a_column_of_zeros_may_stand_for_several_rates(importer: Importer) -> None:
    text = TABLE.replace("0.1,0.2,0.3", "0.0,0.2,0.0").replace("q,r,", "q,unused,")
    found = importer(*table(importer.folder, text, COLUMNS.replace("[p, q, r]", "[p, q, p]"))).bag
    np.testing.assert_array_equal(found.rates, np.tile([0.0, 0.2, 0.0], (300, 1)))


# --- refusals -----------------------------------------------------------------------------------


def file(name: str, content: bytes) -> Make:
    return lambda folder: [str(written(folder / name, content))]


def pipe(path: Path) -> str:
    os.mkfifo(path)
    return str(path)


def px4(*left_out: str, more: Any = (), parameters: Any = (), options: str = "") -> Make:
    def make(folder: Path) -> list[str]:
        topics = {key: v for key, v in (GOOD | dict(more)).items() if key[0] not in left_out}
        log = write_ulog(folder / "good.ulg", topics, dict(parameters))
        return [str(log), *options.split()]

    return make


def firmware(said: bytes) -> Make:
    return lambda folder: [str(write_dataflash(folder / "log", [(0, "MSG", (said,))], {}))]


def bomb(*formats: str) -> Make:
    """Return a ULog with circular or unbounded nested formats."""
    parts = [*(message("F", f.encode()) for f in formats), message("A", b"\0\0\0a")]
    return file("bomb.ulg", MAGIC + b"\1" + bytes(8) + b"".join(parts))


def of_table(text: str) -> Make:
    return lambda folder: table(folder, text)


def of_map(old: str, new: str) -> Make:
    return lambda folder: table(folder, columns=COLUMNS.replace(old, new))


def first(old: str, new: str) -> Make:
    return of_table(TABLE.replace(old, new))


def sdlog2(folder: Path) -> list[str]:
    """Write a log of PX4 before ULog: framed as ArduPilot's, with messages that hold the time."""
    six = "AccX,AccY,AccZ,GyroX,GyroY,GyroZ"
    formats = {
        "PARM": ("Nf", "Name,Value"),
        "TIME": ("Q", "StartTime"),
        "IMU": ("Qffffff", f"T,{six}"),
    }
    rows: Rows = [(t, name, ()) for t in range(0, 10**6, 4000) for name in ("TIME", "IMU")]
    return [str(write_dataflash(folder / "log001.px4log", rows, {"MC_ROLL_P": 6.5}, formats))]


TELEMETRY = bytes.fromhex("000572ed02b6d368fe1afb01011b") + bytes(300)
"""Start of a MAVLink telemetry log: microseconds since 1970, then a message of version 1."""

NOISE = bytes(range(256)) * 40
MOTORS = {("actuator_motors", 0): commands(IMU_NS[::4], VALUES[::4], "control")}
WITHOUT_THRUST = {("actuator_controls_0", 0): commands(IMU_NS[::4], VALUES[::4], "control")}
NEVER_ON = {("actuator_motors", 0): commands(IMU_NS[::4], np.full((500, 12), np.nan), "control")}
VEHICLE = {"timestamp": stamps(IMU_NS[:3]), "vehicle_type": np.full(3, 3, np.uint8)}
TORQUE, ONE_ROTOR = "vehicle_torque_setpoint", {"CA_ROTOR_COUNT": 4, "CA_AIRFRAME": 0}
TWO_PARTS = ("b:c[65535] y;", "a:uint64_t timestamp;b[65535] x;")

PLANE = [(0, "MSG", (b"ArduPlane V4.2.3 (55685c43)",))]

REFUSED: list[tuple[str, Make]] = [
    # files
    ("nowhere.ulg' cannot be read: No such file", lambda folder: [str(folder / "nowhere.ulg")]),
    ("has no table of ulog2csv, as LOG_sensor_combined_0.csv", lambda folder: [str(folder)]),
    ("flight.ulg' is empty", file("flight.ulg", b"")),
    ("of no known kind", file("flight.ulg", NOISE)),
    ("folder '.*multisine' is a ROS bag: give it to replay", lambda _: [str(BAGS / "multisine")]),
    ("flight.zip' is an archive: unpack it", file("flight.zip", b"PK\x03\x04" + bytes(60))),
    ("flight.ulg.gz' is an archive: unpack it", file("flight.ulg.gz", b"\x1f\x8b\x08" + bytes(60))),
    ("flight.bag' is a ROS bag: give it to replay", file("flight.bag", b"#ROSBAG V2.0\n" + NOISE)),
    ("a.mcap' is a ROS bag: give it to replay", file("a.mcap", b"\x89MCAP0\r\n" + NOISE)),
    ("a.mat' is a MATLAB or HDF5 file: write", file("a.mat", b"MATLAB 5.0 MAT-file" + NOISE)),
    ("a.log' is a dataflash log as text: give", file("a.log", b"FMT, 128, 89, FMT, BBnNZ, T\n")),
    ("a.tlog' is a telemetry log of MAVLink, which is too", file("a.tlog", TELEMETRY)),
    ("is a pointer of Git LFS: fetch", file("a.ulg", b"version https://git-lfs.github.com/spec\n")),
    ("log001.px4log' is of sdlog2, PX4's format before ULog: write it into a CSV", sdlog2),
    ("short.ulg' is no readable ULog file", file("short.ulg", MAGIC + b"\1" + bytes(2))),
    ("it has no messages at all", file("short.ulg", MAGIC + b"\1" + bytes(8))),
    ("'/dev/zero' is no regular file", lambda folder: ["/dev/zero"]),
    ("pipe.bin' is no regular file", lambda folder: [pipe(folder / "pipe.bin")]),
    # logs
    ("has no rates .*it has vehicle_torque_setpoint", px4("sensor_combined")),
    ("has no actuators .*it has sensor_combined", px4(TORQUE)),
    ("has no actuators .*it has actuator_controls_0, s", px4(TORQUE, more=WITHOUT_THRUST)),
    ("has no rates .*it has .*PARM", lambda folder: [str(plane_log(folder, "IMU"))]),
    (r"no rates .*it has .*MSG, PARM \(LOG_BITMASK 1029: make it 525317, 'raw IMU'\)$",
     lambda folder: [str(write_dataflash(folder / "slow.bin", PLANE, {"LOG_BITMASK": 1029}))]),
    ("has no actuators .*it has .*PARM", lambda folder: [str(plane_log(folder, "RCOU"))]),
    ("there are sensor_combined, sensor_gyro, v", px4(options="--rates-topic sensor_mag")),
    ("actuator_motors", px4(options="--actuators-topic servos")),
    (r"has no actuators \(actuator_c", px4(options="--actuators-topic actuator_controls_0")),
    ("has no airspeed", px4(options="--airspeed")),
    (r"no usable parameters: 'imu.lever_arm' is \[1000.0, 0.0, 0.0\]: allowed is -100 to 100 m",
     px4(parameters={"EKF2_IMU_POS_X": 1000.0})),
    (r"\(CA_ROTOR\*, CA_SV_CS\*\)", px4(more=MOTORS, options="--actuators-topic actuator_motors")),
    ("hold no value throughout", px4(TORQUE, more=NEVER_ON, parameters=ONE_ROTOR)),
    ("is of a rover .MAV_TYPE 10.: the model is that of an air", px4(parameters={"MAV_TYPE": 10})),
    ("is of a boat .MAV_TYPE 11.", px4(parameters={"MAV_TYPE": 11})),
    ("is of a rover .CA_AIRFRAME 5.", px4(parameters={"CA_AIRFRAME": 5})),
    ("is of a rover .vehicle_status.vehicle_type 3.", px4(more={("vehicle_status", 0): VEHICLE})),
    ("it has no messages at all", bomb(*TWO_PARTS, "c:uint64_t[65535] z;")),
    ("it has no messages at all", bomb(*TWO_PARTS, "c:")),
    ("it has no messages at all", bomb("a:uint64_t timestamp;a again;")),
    ("it has no messages at all", bomb("a:uint64_t timestamp;uint64_t timestamp;")),
    ("log' is of a rover or boat .it calls itself Rover.", firmware(b"APM:Rover v2.46")),
    ("log' is of a rover or boat .it calls", firmware(b"ArduRover V4.2.3 (1c1d4d1e)")),
    ("log' is of a submarine .it calls itself", firmware(b"ArduSub V4.1.0 (f2af3c7e)")),
    ("log' is of an antenna tracker .it calls itself", firmware(b"AntennaTracker V1.1.0")),
    ("log' is of a blimp .it calls itself", firmware(b"Blimp V4.5.0-dev")),
    ("FRAME_CLASS 0 and .* not known here .*try --actuators-topic RATE",
     lambda folder: [str(plane_log(folder, servos=(33, 34, 35)))]),
    ("has 3 motors: only quadrotors are known", file("log.bbl", blackbox(fields=FIELDS[:-1]))),
    (r"no rates \(gyroUnfilt, gyroADC\); it has accSmooth, motor", file("log.bbl", blackbox(
        fields=[name for name in FIELDS if not name.startswith("gyro")]))),
    ("has no frames that can be read", file("log.bbl", blackbox(0))),
    ("no SERVOn_FUNCTION names", lambda folder: [str(plane_log(folder, servos=()))]),
    # tables
    ("--columns FILE.*t,p,q,r,de", lambda folder: table(folder)[:1]),
    ("no column 'de'; it has t, p, q, r", first("t,p,q,r,de", "t,p,q,r,elevator")),
    ("no column 'r'", first("t,p,q,r,de", "t,p,q,R,de")),
    ("no column 'rate_p'; it has t, rate_P, .*: did you mean 'rate_P'", lambda folder: table(
     folder, TABLE.replace("t,p,", "t,rate_P,"), COLUMNS.replace("[p,", "[rate_p,"))),
    ("it has t;p;q;r;de: if that is several columns, 'delimiter' is not ','",
     of_table(TABLE.replace(",", ";"))),
    ("line 102: 'fa,5' is no number: decimals need a point",
     lambda folder: table(folder, TABLE.replace(",", ";").replace("1.00;0.1", "1.00;fa,5"),
                          COLUMNS + "delimiter: ';'\n")),
    ("the time is '1,00', which is no number: decimals need a point",
     lambda folder: table(folder, TABLE.replace(",", ";").replace("\n1.00;", "\n1,00;"),
                          COLUMNS + "delimiter: ';'\n")),
    ("flight.csv': its header has column 'p' more than once: rename", first("q,r,de", "p,q,r,de")),
    ("line 102: 'fast' is no number", first("1.00,0.1", "1.00,fast")),
    ("line 102: the time is 'noon'", first("1.00,0.1", "noon,0.1")),
    ("line 102: the time is '-1.0': a stamp holds 0 to", first("1.00,0.1", "-1.0,0.1")),
    ("line 102: the time is '1e300': a stamp holds", first("1.00,0.1", "1e300,0.1")),
    ("line 102: the time is 'inf'", first("1.00,0.1", "inf,0.1")),
    ("line 102: the time is 'nan', which is no number", first("1.00,0.1", "nan,0.1")),
    ("goes on in 0 rows and back",
     of_table(TABLE[:11] + "".join(TABLE[11:].splitlines(True)[::-1]))),
    ("goes on in 0 rows and back in 0: sort the", of_table(re.sub(r"(?m)^[0-9.]+", "3.0", TABLE))),
    ("no complete row", of_table("t,p,q,r,de\n")),
    ("has no rates: columns p, q, r are empty", of_table("t,p,q,r,de\n1.0,,,,0.5\n")),
    ("has no actuators: columns de are empty", of_table("t,p,q,r,de\n1.0,1,2,3,\n")),
    ("flight.csv': it is empty: a header line is needed", of_table("# nothing\n\n")),
    # maps of tables
    ("columns.yaml'.*unknown entry 'tyme': did you mean 'time'", of_map("time:", "tyme:")),
    ("rates.unit is 'rpm': allowed are rad/s, deg/s", of_map("unit: rad/s", "unit: rpm")),
    ("rates.unit is missing", of_map(", unit: rad/s", "")),
    ("rates.counts is 0: how many counts make up", of_map("rad/s}", "deg/s, counts: 0}")),
    ("the file has no axes", of_map("axes: frd\n", "")),
    ("three columns x, y, z are needed", of_map("[p, q, r]", "[p, q]")),
    ("elevator.de is 'up': a finite number is needed", of_map("de: 1.0", "de: up")),
    ("no channel has a weight", of_map(", de: 1.0", "")),
    ("channels.elevator has an unknown entry 'dq'", of_map("de: 1.0", "dq: 1.0")),
    ("columns.yaml': line 6: 'elevator' is there twice: keep one",
     of_map("channels:", "channels:\n  elevator: {column: da, de: 0.5}")),
    ("channels.elevator: column 'de' is used twice: keep one of its channels", of_map("channels:",
     "channels:\n  de: {da: 0.5}")),
    ("flight.csv': the column map takes column 'de' twice, for rates: name the column of each",
     of_map("[p, q, r]", "[p, de, de]")),
    ("takes column 'de' twice, for rates and channels:", of_map("[p, q, r]", "[p, q, de]")),
    ("columns.yaml': line [1-6]: ", of_map("time: {column: t}", "time: {")),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_an_unusable_file_is_refused_in_one_line(number: int, importer: Importer) -> None:
    words, make = REFUSED[number]
    printed = importer.refused(*make(importer.folder))
    assert re.search(words, printed), printed


def test_motors_without_geometry_are_not_used(importer: Importer) -> None:
    it = importer(*px4(more=MOTORS)(importer.folder))
    assert "actuators: vehicle_torque_setpoint" in it.printed


def test_the_example_of_the_help_is_a_valid_column_map(tmp_path: Path) -> None:
    from uav_ident_ros.import_logs.csv_table import EXAMPLE, load_column_map

    (tmp_path / "columns.yaml").write_text(EXAMPLE, encoding="utf-8")
    found = load_column_map(tmp_path / "columns.yaml")
    assert found.quantities["airspeed"] == (["tas"], 1.0)


STAMPS = 4_000_000 * np.arange(500) + 20 * NS_PER_S


@pytest.mark.parametrize("places", [[0], [1], [250], [250, 251], [497], [3, 100, 400]])
@pytest.mark.parametrize("value", [0, 5 * NS_PER_S, 9000 * NS_PER_S, 2**31 * NS_PER_S, -1])
def test_single_damaged_stamps_are_found(places: list[int], value: int) -> None:
    t_ns = STAMPS.copy()
    t_ns[places] = value
    early = value < STAMPS[0] and places == [0]  # like the first message of a latched topic
    expected = np.arange(len(t_ns)) if early and value >= 0 else np.delete(np.arange(500), places)
    np.testing.assert_array_equal(np.flatnonzero(plausible(t_ns)), expected)


@pytest.mark.parametrize(
    "t_ns",
    [
        STAMPS,
        STAMPS[:3],
        np.array([1, 200, 201, 202, 900, 901, 2000]) * NS_PER_S,  # changes of a state
        np.array([20.2, 25.83, 25.836, 26.0, 26.2, 26.4, 31.0]) * NS_PER_S,
        np.r_[STAMPS, STAMPS[-1] + 60 * NS_PER_S],  # a late stamp
        np.r_[STAMPS[:200], STAMPS[300:] + 60 * NS_PER_S],  # a gap
        np.r_[STAMPS + 60 * NS_PER_S, STAMPS],  # a restart of the autopilot
        STAMPS + np.random.default_rng(1).integers(-(10**8), 10**8, len(STAMPS)),  # unsorted
    ],
)
def test_gaps_late_stamps_and_restarts_are_no_damage(t_ns: np.ndarray) -> None:
    assert plausible(np.asarray(t_ns, dtype=np.int64)).all()
