# SPDX-License-Identifier: Apache-2.0
"""Tables (`.csv`) with one row per instant, and the YAML file that says what their columns mean."""

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
    finite,
    mapping,
    meant,
    nanoseconds,
    problem,
)
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.import_logs.flight_log import (
    Channel,
    FlightLog,
    ImportLogError,
    Stream,
    rates_stream,
)
from uav_ident_ros.import_logs.log import IN_NS, Column, Log, Messages
from uav_ident_ros.import_logs.stamps import LATEST_NS

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "rates": {"rad/s": 1.0, "deg/s": math.pi / 180.0},
    "specific_force": {"m/s^2": 1.0, "g": GRAVITY},
    "airspeed": {"m/s": 1.0, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0},
}
"""Units of each quantity, SI, of the time ns; the first is the usual one."""

OPTIONAL = ("specific_force", "airspeed")

VECTORS = ("rates", "specific_force")
"""Quantities of three columns, perhaps in counts of a raw sensor."""

AXES = ("frd", "flu")
AXES_OF_A_VECTOR = 3

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
class Quantity:
    """Columns that hold a quantity, and its unit."""

    columns: tuple[str, ...] = ()  # None if the table does not have it
    factor: float = 1.0  # Of the unit, SI; that of the time in ns

    def of(self, rows: Messages) -> FloatArray:
        """Return the values of a table, SI, shape (k, number of columns)."""
        return rows.values(*self.columns) * self.factor


@dataclass(frozen=True)
class ColumnMap:
    """Meaning of the columns of a table."""

    quantities: Mapping[str, Quantity]  # By name, those of `UNITS`
    channels: dict[str, Channel]  # Channel by column
    axes: str  # ``frd`` or ``flu``
    lever_arm: tuple[float, float, float]  # Accelerometer from the centre of gravity, m, FRD
    delimiter: str  # Between the cells

    @property
    def columns(self) -> list[str]:
        """Every column that is read, the time's first."""
        named = [column for quantity in self.quantities.values() for column in quantity.columns]
        return [*named, *self.channels]


def load_column_map(path: Path) -> ColumnMap:
    """Read a column map.

    Raises
    ------
    ImportLogError
        If it cannot be read, an entry is missing, unknown or not allowed.
    """
    try:
        return _column_map(yaml.safe_load(path.read_text(encoding="utf-8")))
    except UNUSABLE as error:
        raise ImportLogError(
            f"column map '{path}': {problem(error)} (see import_log --help)"
        ) from None


def _column_map(content: Any) -> ColumnMap:
    needed = ("time", "axes", "rates", "channels")
    top = mapping(content, "the file", needed, (*OPTIONAL, "lever_arm", "delimiter"))
    delimiter, axes = top.get("delimiter", ","), top["axes"]
    if not isinstance(delimiter, str) or len(delimiter) != 1:
        raise EntryError(f"delimiter is {delimiter!r}: one character is needed")
    if axes not in AXES:
        raise EntryError(f"axes is '{axes}': allowed are {', '.join(AXES)}")
    arm = _three(top.get("lever_arm", [0.0, 0.0, 0.0]), "lever_arm", "numbers forward, right, down")
    x, y, z = (finite(value, "lever_arm") for value in arm)
    quantities = {name: _quantity(top, name) for name in UNITS}
    return ColumnMap(quantities, _channels(top["channels"]), axes, (x, y, z), delimiter)


def _quantity(top: Mapping[str, Any], name: str) -> Quantity:
    """Return the columns and the unit of a quantity, nothing if the table does not have it."""
    if name not in top:
        return Quantity()
    key, more = ("columns", ("unit", "counts")) if name in VECTORS else ("column", ("unit",))
    entry = mapping(top[name], name, (key,), more)
    units = UNITS[name]
    # Rates in the wrong unit would pass for others.
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
    return Quantity(tuple(map(str, columns)), units[unit] / counts)


def _channels(content: Any) -> dict[str, Channel]:
    numbers = ("trim", "neutral", "scale", *INPUTS)
    channels: dict[str, Channel] = {}
    for name, value in mapping(content, "channels", (), content or ()).items():
        where = f"channels.{name}"
        entry = mapping(value, where, (), ("column", "unit", *numbers))
        column = str(entry.get("column", name))
        if column in channels:
            raise EntryError(f"{where}: column '{column}' is used twice")
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
        raise EntryError(f"no channel says what it moves: give weights of {', '.join(INPUTS)}")
    return channels


def _three(value: Any, name: str, what: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != AXES_OF_A_VECTOR:
        raise EntryError(f"{name} is {value!r}: three {what} are needed")
    return value


TOO_LATE = "; shift the column, or say its unit in the column map"

COMMENT = "#"
"""Lines that begin with it are skipped."""

EMPTY = ("", "nan", "NaN", "NA", "null")
"""Cells without a value: the stream has no sample in this row."""


def read_csv(path: Path, columns: ColumnMap) -> FlightLog:
    """Read a table.

    A row gives a sample of the rates if it has all three, one of the actuators if it has any
    channel, and so on: streams of different rates fit into one table with empty cells.

    Raises
    ------
    ImportLogError
        If it cannot be read, a column is missing, a cell is no number, or there are no samples.
    """
    log = Log(path, "table")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            log.add("the table", 0, _read_columns(file, columns, log))
        streams = _streams(log.messages("the table"), columns)
    except (*UNUSABLE, csv.Error) as error:
        raise ImportLogError(f"table '{path}': {problem(error)}") from None
    if not columns.quantities["specific_force"].columns:
        log.findings.doubt("there is no accelerometer: ay and az are zero")
    log.findings.note(
        f"units and axes from the column map: rates in body axes {columns.axes}, times "
        f"{columns.quantities['rates'].factor:.6g} to rad/s"
    )
    log.findings.assume(
        "the stamp of a row is that of all its values, unfiltered; the table does not say when it "
        "flew"
    )
    return FlightLog(
        path,
        log.title,
        streams,
        tuple(columns.channels.values()),
        log.findings,
        convention=columns.axes,
        lever_arm=columns.lever_arm,
    )


def _streams(rows: Messages | None, columns: ColumnMap) -> dict[str, Stream]:
    """Return the streams of a table whose rows follow each other in time."""
    if rows is None:
        raise EntryError("it has no row with a stamp that a clock gave")
    t_ns = rows.stamp_ns
    steps = np.diff(t_ns)
    back, ahead = int((steps < 0).sum()), int((steps > 0).sum())
    if len(t_ns) > 1 and back >= ahead:
        raise EntryError(
            f"the time goes on in {ahead} rows and back in {back}: sort the rows by their time"
        )
    rates, force, speed = (columns.quantities[name] for name in ("rates", *OPTIONAL))
    streams: dict[str, Stream] = {}

    def add(what: str, names: Collection[str], stream: Stream, some: Any = np.all) -> None:
        there = some(np.isfinite(rows.values(*names)), axis=1)
        if not there.any():
            raise EntryError(f"it has no {what}: columns {', '.join(names)} are empty")
        streams[what] = stream.chosen(there)

    measured = force.of(rows) if force.columns else None
    add("rates", rates.columns, rates_stream("table", t_ns, rates.of(rows), measured))
    commands = rows.values(*columns.channels)
    add("actuators", columns.channels, Stream("table", t_ns, commands), np.any)
    if speed.columns:
        add("airspeed", speed.columns, Stream("table", t_ns, speed.of(rows)[:, 0]))
    return streams


def _read_columns(file: Iterator[str], columns: ColumnMap, log: Log) -> dict[str, Column]:
    """Return the columns of the map, NaN where empty, and the stamps."""
    reader = csv.reader(file, delimiter=columns.delimiter)
    rows = (
        (reader.line_num, [cell.strip() for cell in cells])
        for cells in reader
        if any(cells) and not cells[0].lstrip().startswith(COMMENT)
    )
    _, header = next(rows, (0, []))
    if not header:
        raise EntryError("it is empty: a header line is needed")
    for name in columns.columns:
        if name not in header:
            listed = ", ".join(header)
            raise EntryError(f"it has no column '{name}'; it has {listed}: {meant(name, header)}")
    place, *places = (header.index(name) for name in columns.columns)
    unit_ns = int(columns.quantities["time"].factor)
    t_ns, values, short = [], [], []
    for line, cells in rows:
        if len(cells) <= max(place, *places):
            short.append(line)
            continue
        where = f"line {line}: the time"
        t_ns.append(nanoseconds(cells[place], unit_ns, LATEST_NS, where, TOO_LATE))
        values.append([_number(line, cells[other]) for other in places])
    if not values:
        raise EntryError("it has no complete row below its header")
    if short:
        log.findings.doubt(
            f"{len(short)} rows have too few cells and were left out, the first in line {short[0]}"
        )
    named = zip(columns.columns[1:], np.array(values).T, strict=True)
    return {IN_NS: np.array(t_ns, dtype=np.int64), **dict(named)}


def _number(line: int, cell: str) -> float:
    try:
        return float("nan" if cell in EMPTY else cell)
    except ValueError:
        raise EntryError(f"line {line}: '{cell}' is no number") from None
