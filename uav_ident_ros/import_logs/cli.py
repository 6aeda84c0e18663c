# SPDX-License-Identifier: Apache-2.0
"""`import_log`: a PX4 or ArduPilot log, or a table, as a bag with the standard topics."""

import argparse
import re
import shlex
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from uav_ident_ros.commandline import LINE_LENGTH, USAGE_ERROR, OneLineParser, given_path
from uav_ident_ros.import_logs import blackbox, dataflash, px4_log
from uav_ident_ros.import_logs.ardupilot import read_ardupilot
from uav_ident_ros.import_logs.csv_table import EXAMPLE, load_column_map, read_csv
from uav_ident_ros.import_logs.flight_log import (
    LONGEST_TITLE,
    TRIMS,
    Choice,
    FlightLog,
    printable,
)
from uav_ident_ros.import_logs.log import ImportLogError
from uav_ident_ros.import_logs.px4 import read_px4
from uav_ident_ros.import_logs.stamps import describe, irregularities

DAMAGED = 1
"""Exit status if a part of the log could not be read."""

READERS = {
    px4_log.MAGIC: read_px4,
    dataflash.MAGIC: read_ardupilot,
    blackbox.MAGIC: blackbox.read_blackbox,
}
"""Readers by the first bytes of a log."""

FOREIGN = {
    rb"PK\x03\x04|\x1f\x8b|7z\xbc\xaf|\xfd7zXZ|BZh|\x28\xb5\x2f\xfd": "an archive: unpack it first",
    rb"#ROSBAG V|\x89MCAP0|SQLite format 3": "a ROS bag: give it to replay as it is",
    rb"MATLAB |\x89HDF": "a MATLAB or HDF5 file: write its signals into a CSV, and give --columns",
    rb"FMT *, *\d": "a dataflash log as text: give the .bin that it was made from",
    rb"\x00[\x04-\x07].{6}[\xfd\xfe]": "a telemetry log of MAVLink, which is too slow: give the "
    "autopilot's own log (.bin, .ulg)",
    rb"version https://git-lfs": "a pointer of Git LFS: fetch the file itself with 'git lfs pull'",
}
"""Files that cannot be read, by a pattern of their first bytes: what they are, and what to do."""

FIRST_BYTES = 400
"""Bytes read to recognise a log; they contain the header line of a table."""

_DESCRIPTION = """\
Turn a PX4 log (.ulg), an ArduPilot dataflash log (.bin), a blackbox log of Betaflight (.bbl) or a
table (.csv with a column map) into an MCAP bag with /imu/data, /actuators (named channels) and,
if the log has them, /airspeed, /armed, /mode and /setpoint/rates. identifier.yaml beside it holds
the parameters for it. The facts read from the log and the assumptions are printed, and written into
that file."""

_EPILOG = f"""\
examples:
  import_log flight.ulg
  import_log flight.bin --output bags/flight --trim neutral
  import_log flight.csv --columns columns.yaml

a column map, for a table with the columns t, p, q ...:
{textwrap.indent(EXAMPLE, "  ")}"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = OneLineParser(
        prog="import_log",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = result.add_argument
    add("log", type=given_path, metavar="LOG",
        help="log file, recognised by its first bytes, or a folder of ulog2csv")  # fmt: skip
    add(
        "--output",
        type=given_path,
        metavar="DIR",
        help="folder of the new bag (default: LOG's name)",
    )
    add("--columns", type=given_path, metavar="FILE", help="column map of a table")
    add("--rates-topic", metavar="NAME",
        help="PX4 topic or ArduPilot message of the rates (default: raw and fast)")  # fmt: skip
    add("--actuators-topic", metavar="NAME",
        help="PX4 topic or ArduPilot message of the commands (default: nearest to the "
             "actuators that is fast enough)")  # fmt: skip
    add("--rates-instance", type=int, default=0, metavar="I", help="which gyro, of several (0)")
    add("--actuators-instance", type=int, default=0, metavar="I",
        help="which set of commands, of several: a PX4 VTOL's hover 0, forward flight 1 "
             "(0)")  # fmt: skip
    add("--trim", choices=TRIMS, default=TRIMS[0],
        help="trim of the channels: median in flight, rest position, or learnt by the "
             "identifier from steady flight (flight)")  # fmt: skip
    add("--airspeed", action=argparse.BooleanOptionalAction,
        help="use the airspeed (default: if it was measured for most of the flight)")  # fmt: skip
    add("--flight-only", action="store_true", help="leave out what was logged on the ground")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status, `DAMAGED` if a part of the log is unreadable."""
    options = parser().parse_args(arguments)
    from uav_ident_ros.bags.writing import BagWriteError  # help needs none of these
    from uav_ident_ros.files.parameter_file import PARAMETER_FILE
    from uav_ident_ros.import_logs.writing import fitting, log_summary, write_import

    folder: Path = options.output or Path(options.log.stem)
    try:
        if folder.exists():
            raise ImportLogError(f"'{folder}' exists already: choose another --output")
        flight = read_log(options)
        values = fitting(flight, options.trim, options.airspeed)
        write_import(flight, values, folder)
    except (ImportLogError, BagWriteError) as error:
        print(f"import_log: {printable(str(error))}", file=sys.stderr)
        return USAGE_ERROR
    print(f"{flight.log.path.name}: {flight.log.title}")
    item = textwrap.TextWrapper(LINE_LENGTH, initial_indent="  - ", subsequent_indent="    ")
    for title, sentences in log_summary(flight, values).items():
        print(f"\n{title}", *map(item.fill, sentences), sep="\n")
    following = shlex.join(["replay", str(folder), "--params-file", str(folder / PARAMETER_FILE)])
    print(f"\nwritten to {folder}; next: {following}")
    return DAMAGED if flight.log.findings.damage else 0


def read_log(options: argparse.Namespace) -> FlightLog:
    """Read the log by the options; every failure of a reader becomes an `ImportLogError`."""
    try:
        flight = _read(options.log, options)
    except ImportLogError:
        raise
    except Exception as error:  # damaged bytes make readers fail in any way
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ImportLogError(
            f"log '{options.log}' cannot be used: its content is inconsistent ({reason})"
        ) from error
    flight.log.title = printable(flight.log.title, LONGEST_TITLE)
    if options.flight_only:
        flight = flight.only_flight()
    _note_streams(flight)
    return flight


def _read(path: Path, options: argparse.Namespace) -> FlightLog:
    """Read the log with the reader for its first bytes."""
    if (path / "metadata.yaml").exists():
        raise ImportLogError(f"folder '{path}' is a ROS bag: give it to replay as it is")
    start = px4_log.MAGIC if path.is_dir() else _first_bytes(path)
    choice = Choice(**{f.name: getattr(options, f.name) for f in fields(Choice)})
    for magic, read in READERS.items():
        if start.startswith(magic):
            return read(path, choice)
    for pattern, kind in FOREIGN.items():
        if re.match(pattern, start, re.DOTALL):
            raise ImportLogError(f"log '{path}' is {kind}")
    if options.columns is not None:
        if choice != Choice():
            raise ImportLogError(
                f"table '{path}': the column map names its columns; leave --rates-topic and the "
                "like out"
            )
        return read_csv(path, load_column_map(options.columns))
    if path.suffix.lower() in (".csv", ".txt", ".tsv"):
        raise ImportLogError(
            f"table '{path}': say what its columns mean with --columns FILE. It begins with: "
            f"{start.decode(errors='replace').splitlines()[0]}"
        )
    raise ImportLogError(
        f"log '{path}' is of no known kind: it begins neither like a PX4 ULog nor an ArduPilot "
        "dataflash log nor a blackbox log; a table needs --columns"
    )


def _first_bytes(path: Path) -> bytes:
    if path.exists() and not path.is_file():
        raise ImportLogError(f"log '{path}' is no regular file: give a file on a disk")
    try:
        with path.open("rb") as file:
            start = file.read(FIRST_BYTES)
    except OSError as error:
        raise ImportLogError(f"log '{path}' cannot be read: {error.strerror}") from None
    if not start:
        raise ImportLogError(f"log '{path}' is empty")
    return start


def _note_streams(flight: FlightLog) -> None:
    """Add rates, gaps and other irregularities of the streams to the findings."""
    findings = flight.log.findings
    for name, stream in flight.streams.items():
        if name != "mode":  # a sample for each change: it has no rate
            findings.read.append(f"{name}: {describe(stream.t_ns)}")
            findings.lost += [f"{name}: {text}" for text in irregularities(stream.t_ns)]
    values = flight.streams["actuators"].values[:, [column for column, _ in flight.used]]
    if without := int((~np.isfinite(values)).any(axis=1).sum()):
        findings.lost.append(
            f"actuators: {without} samples lack a value of a channel in use, as of a motor that is "
            "off: they will be dropped"
        )
