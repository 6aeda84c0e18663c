# SPDX-License-Identifier: Apache-2.0
"""Tables (`.csv`) with one row per instant, and their column maps in YAML."""

import csv
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from uav_ident_ros.files.strict_yaml import (
    UNUSABLE,
    EntryError,
    TypedLoader,
    comma,
    finite,
    mapping,
    nanoseconds,
    problem,
)
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.settings import nearest
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.import_logs.flight_log import Channel, FlightLog
from uav_ident_ros.import_logs.log import IN_NS, Column, ImportLogError, Log, LogStream, Messages
from uav_ident_ros.import_logs.stamps import BEYOND_STAMPS_NS

UNIT_FACTORS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "rates": {"rad/s": 1.0, "deg/s": math.pi / 180.0},
    "specific_force": {"m/s^2": 1.0, "g": GRAVITY},
    "airspeed": {"m/s": 1.0, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0},
}
"""Units of each quantity in SI, of the time in ns; the first is the default."""

VECTORS = ("rates", "specific_force")
"""Quantities of three columns, in units or in counts of a raw sensor."""

EXAMPLE = """\
time: {column: t, unit: s}
axes: frd
rates: {columns: [p, q, r], unit: rad/s}
specific_force: {columns: [ax, ay, az], unit: m/s^2}
airspeed: {column: tas, unit: m/s}
channels:
  elevator: {column: servo_2, trim: 1500.0, scale: 0.002, de: 1.0}
  throttle: {column: servo_3, neutral: 1000.0, scale: 0.001, dth: 1.0}
"""
"""A column map, for the help and the documentation."""


@dataclass(frozen=True)
class ColumnMap:
    """Meaning of the columns of a table."""

    # Columns and unit (SI or ns) of each quantity of `UNIT_FACTORS` in the table
    quantities: Mapping[str, tuple[list[str], float]]
    channels: dict[str, Channel]  # Channel by column
    axes: str  # ``frd`` or ``flu``
    lever_arm: tuple[float, float, float]  # Accelerometer from the centre of gravity, m, FRD
    delimiter: str  # Separator of the cells


def load_column_map(path: Path) -> ColumnMap:
    """Read a column map; an `ImportLogError` names a missing, unknown or wrong entry."""
    try:
        return _column_map(yaml.load(path.read_text(encoding="utf-8"), TypedLoader))
    except UNUSABLE as error:
        raise ImportLogError(
            f"column map '{path}': {problem(error)} (see import_log --help)"
        ) from None


def _column_map(content: Any) -> ColumnMap:
    needed = ("time", "axes", "rates", "channels")
    optional = ("specific_force", "airspeed", "lever_arm", "delimiter")
    top = mapping(content, "the file", needed, optional)
    delimiter, axes = top.get("delimiter", ","), top["axes"]
    if not isinstance(delimiter, str) or len(delimiter) != 1:
        raise EntryError(f"delimiter is {delimiter!r}: one character is needed")
    if axes not in ("frd", "flu"):
        raise EntryError(f"axes is '{axes}': allowed are frd, flu")
    arm = _three(top.get("lever_arm", [0.0, 0.0, 0.0]), "lever_arm", "numbers forward, right, down")
    x, y, z = (finite(value, "lever_arm") for value in arm)
    quantities = {name: _quantity(top[name], name) for name in UNIT_FACTORS if name in top}
    return ColumnMap(quantities, _channels(top["channels"]), axes, (x, y, z), delimiter)


def _quantity(content: Any, name: str) -> tuple[list[str], float]:
    """Return the columns and the unit of a quantity."""
    key, more = ("columns", ("unit", "counts")) if name in VECTORS else ("column", ("unit",))
    entry = mapping(content, name, (key,), more)
    units = UNIT_FACTORS[name]
    # Rates in a wrong unit look plausible: their unit has no default.
    unit = entry.get("unit", None if name == "rates" else next(iter(units)))
    if unit not in [*units]:
        found = "missing" if unit is None else f"'{unit}'"
        raise EntryError(f"{name}.unit is {found}: allowed are {', '.join(units)}")
    counts = finite(entry.get("counts", 1.0), f"{name}.counts")
    if not counts:
        raise EntryError(f"{name}.counts is 0: how many counts make up one unit?")
    columns = [entry[key]]
    if name in VECTORS:
        columns = _three(entry[key], f"{name}.columns", "columns x, y, z")
    return [*map(str, columns)], units[unit] / counts


def _channels(content: Any) -> dict[str, Channel]:
    numbers = ("trim", "neutral", "scale", *INPUTS)
    channels: dict[str, Channel] = {}
    for name, value in mapping(content, "channels", (), content or ()).items():
        where = f"channels.{name}"
        entry = mapping(value, where, (), ("column", "unit", *numbers))
        column = str(entry.get("column", name))
        if column in channels:
            raise EntryError(f"{where}: column '{column}' is used twice: keep one of its channels")
        given = {
            key: finite(entry[key], f"{where}.{key}")
            for key in numbers
            if entry.get(key) is not None
        }
        de, dr, da, dth = (given.pop(key, 0.0) for key in INPUTS)
        unit = str(entry.get("unit", "as in the table"))
        effect, meaning = (de, dr, da, dth), f"column '{column}'"
        channels[column] = Channel(str(name), effect, meaning, unit=unit, **given)
    if not any(any(channel.effect) for channel in channels.values()):
        raise EntryError(f"no channel has a weight: give weights of {', '.join(INPUTS)}")
    return channels


def _three(value: Any, name: str, what: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != 3:
        raise EntryError(f"{name} is {value!r}: three {what} are needed")
    return value


TOO_LATE = "; shift the column, or say its unit in the column map"

NO_VALUE = ("", "nan", "NaN", "NA", "null")
"""Cells without a value: the stream has no sample in this row."""


def read_csv(path: Path, columns: ColumnMap) -> FlightLog:
    """Read a table.

    A row is a sample of a stream if all the stream's cells have values; one channel suffices for
    the actuators. Streams of different rates thus share a table with empty cells. A channel that
    lifts and also rolls or pitches is a multirotor's motor.
    """
    log = Log(path, "table")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            log.add("the table", _read_columns(file, columns, log))
        streams = _streams(log.messages("the table"), columns)
    except (*UNUSABLE, csv.Error) as error:
        raise ImportLogError(f"table '{path}': {problem(error)}") from None
    channels = tuple(columns.channels.values())
    hovers = any(dth and (de or da) for de, _, da, dth in (c.effect for c in channels))
    if "specific_force" not in columns.quantities:
        log.findings.lost.append("there is no accelerometer: ay and az are zero")
    elif not hovers:
        log.findings.assumed.append(
            "the aircraft has wings: a table does not say so. For a multirotor set 'structure' to "
            "'augmented'"
        )
    log.findings.read.append(
        f"units and axes from the column map: rates in body axes {columns.axes}, times "
        f"{columns.quantities['rates'][1]:.6g} to rad/s"
    )
    log.findings.assumed.append(
        "the stamp of a row is that of all its values, unfiltered; the table does not say when it "
        "flew"
    )
    return FlightLog(log, streams, channels, columns.axes, columns.lever_arm, hovers=hovers)


def _streams(rows: Messages | None, columns: ColumnMap) -> dict[str, LogStream]:
    """Return the streams of a table; its rows must be in the order of time."""
    if rows is None:
        raise EntryError("it has no row with a plausible stamp")
    _check_distinct(rows, columns)
    t_ns = rows.stamp_ns
    steps = np.diff(t_ns)
    back, ahead = int((steps < 0).sum()), int((steps > 0).sum())
    if len(t_ns) > 1 and back >= ahead:
        raise EntryError(
            f"the time goes on in {ahead} rows and back in {back}: sort the rows by their time"
        )
    measured = {
        name: rows.values(*names) * unit
        for name, (names, unit) in columns.quantities.items()
        if name != "time"
    }
    streams: dict[str, LogStream] = {}

    def add(what: str, names: Collection[str], stream: LogStream, some: Any = np.all) -> None:
        there = some(np.isfinite(rows.values(*names)), axis=1)
        if not there.any():
            raise EntryError(f"it has no {what}: columns {', '.join(names)} are empty")
        streams[what] = stream.chosen(there)

    rates = measured["rates"]
    force = measured.get("specific_force", np.full(rates.shape, np.nan))
    moved = LogStream(rows.name, t_ns, np.hstack([rates, force]))
    add("rates", columns.quantities["rates"][0], moved)
    add("actuators", columns.channels, rows.stream(*columns.channels), np.any)
    if "airspeed" in measured:
        speed = LogStream(rows.name, t_ns, measured["airspeed"][:, 0])
        add("airspeed", columns.quantities["airspeed"][0], speed)
    return streams


def _check_distinct(rows: Messages, columns: ColumnMap) -> None:
    """Raise an `EntryError` if a column is used twice, unless it is constant, as one of zeros."""
    used = [(name, entry) for entry, (names, _) in columns.quantities.items() for name in names]
    taken: dict[str, str] = {}
    for name, entry in [*used, *((name, "channels") for name in columns.channels)]:
        values = rows.columns.get(name, np.zeros(0))  # none of the time alone
        if name in taken and len(np.unique(values[np.isfinite(values)])) > 1:
            places = entry if taken[name] == entry else f"{taken[name]} and {entry}"
            raise EntryError(
                f"the column map takes column '{name}' twice, for {places}: name the column of "
                "each quantity"
            )
        taken[name] = entry


def _read_columns(file: Iterator[str], columns: ColumnMap, log: Log) -> dict[str, Column]:
    """Return the stamps and the mapped columns of a table, NaN for empty cells."""
    reader = csv.reader(file, delimiter=columns.delimiter)
    rows = (
        (reader.line_num, [cell.strip() for cell in cells])
        for cells in reader
        if any(cells) and not cells[0].lstrip().startswith("#")  # a comment
    )
    _, header = next(rows, (0, []))
    if not header:
        raise EntryError("it is empty: a header line is needed")
    ((time,), unit_ns), *others = columns.quantities.values()
    read = [*(name for names, _ in others for name in names), *columns.channels]
    for name in (time, *read):
        if name not in header:
            hint = nearest(name, header)
            if len(header) == 1:
                hint = f"if that is several columns, 'delimiter' is not '{columns.delimiter}'"
            listed = ", ".join(header) + (f": {hint}" if hint else "")
            raise EntryError(f"it has no column '{name}'; it has {listed}")
        if header.count(name) > 1:
            raise EntryError(f"its header has column '{name}' more than once: rename the others")
    place, *places = (header.index(name) for name in (time, *read))
    t_ns, values, short = [], [], []
    for line, cells in rows:
        if len(cells) <= max(place, *places):
            short.append(line)
            continue
        where = f"line {line}: the time"
        t_ns.append(nanoseconds(cells[place], int(unit_ns), BEYOND_STAMPS_NS, where, TOO_LATE))
        values.append([_number(line, cells[other]) for other in places])
    if not values:
        raise EntryError("it has no complete row below its header")
    if short:
        log.findings.damage.append(
            f"{len(short)} rows have too few cells and were left out, the first in line {short[0]}"
        )
    return {
        IN_NS: np.array(t_ns, dtype=np.int64),
        **dict(zip(read, np.array(values).T, strict=True)),
    }


def _number(line: int, cell: str) -> float:
    try:
        return float("nan" if cell in NO_VALUE else cell)
    except ValueError:
        raise EntryError(f"line {line}: '{cell}' is no number{comma(cell)}") from None
