# SPDX-License-Identifier: Apache-2.0
"""Tables (`.csv`) with one row per instant, and the YAML file that says what their columns mean."""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from uav_ident_ros.files.strict_yaml import EntryError, finite, mapping, meant, yaml_problem
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.import_logs.flight_log import (
    Channel,
    Findings,
    FlightLog,
    ImportLogError,
    Stream,
    gyro_and_force,
)
from uav_ident_ros.import_logs.stamps import LATEST_NS
from uav_ident_ros.messages.types import NS_PER_S

TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
"""Nanoseconds in each unit of time."""

RATE_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180.0}
FORCE_UNITS = {"m/s^2": 1.0, "g": GRAVITY}
SPEED_UNITS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0}
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


@dataclass(frozen=True)
class ColumnMap:
    """Meaning of the columns of a table."""

    time: Quantity
    rates: Quantity
    force: Quantity  # Specific force
    airspeed: Quantity  # True airspeed
    channels: dict[str, Channel]  # Channel by column
    axes: str  # ``frd`` or ``flu``
    lever_arm: tuple[float, float, float]  # Accelerometer from the centre of gravity, m, FRD
    delimiter: str  # Between the cells

    @property
    def time_ns(self) -> Decimal:
        """Unit of the time, ns."""
        return Decimal(int(self.time.factor))

    @property
    def columns(self) -> list[str]:
        """Every column that is read, the time's first."""
        quantities = (self.time, self.rates, self.force, self.airspeed)
        return [c for quantity in quantities for c in quantity.columns] + list(self.channels)


def load_column_map(path: Path) -> ColumnMap:
    """Read a column map.

    Raises
    ------
    ImportLogError
        If it cannot be read, an entry is missing, unknown or not allowed.
    """
    try:
        return _column_map(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise ImportLogError(f"column map '{path}' cannot be read: {reason}") from None
    except yaml.YAMLError as error:
        raise ImportLogError(f"column map '{path}' is no YAML: {yaml_problem(error)}") from None
    except EntryError as error:
        raise ImportLogError(f"column map '{path}': {error} (see import_log --help)") from None


def _column_map(content: Any) -> ColumnMap:
    needed = ("time", "axes", "rates", "channels")
    optional = ("specific_force", "airspeed", "lever_arm", "delimiter")
    top = mapping(content, "the file", needed, optional)
    delimiter, axes = top.get("delimiter", ","), top["axes"]
    if not isinstance(delimiter, str) or len(delimiter) != 1:
        raise EntryError(f"delimiter is {delimiter!r}: one character is needed")
    if axes not in AXES:
        raise EntryError(f"axes is '{axes}': allowed are {', '.join(AXES)}")
    arm = _three(top.get("lever_arm", [0.0, 0.0, 0.0]), "lever_arm", "numbers forward, right, down")
    x, y, z = (finite(value, "lever_arm") for value in arm)
    return ColumnMap(
        time=_single(top, "time", TIME_UNITS),
        rates=_vector(top, "rates", RATE_UNITS),
        force=_vector(top, "specific_force", FORCE_UNITS, "m/s^2"),
        airspeed=_single(top, "airspeed", SPEED_UNITS),
        channels=_channels(top["channels"]),
        axes=axes,
        lever_arm=(x, y, z),
        delimiter=delimiter,
    )


def _single(top: Mapping[str, Any], name: str, units: Mapping[str, float]) -> Quantity:
    """Return a quantity of one column; the unit is the first if none is given."""
    if name not in top:
        return Quantity()
    entry = mapping(top[name], name, ("column",), ("unit",))
    return Quantity((str(entry["column"]),), _unit(entry, name, units, next(iter(units))))


def _vector(
    top: Mapping[str, Any], name: str, units: Mapping[str, float], usual: str | None = None
) -> Quantity:
    """Return a quantity of three columns, perhaps in counts of a raw sensor."""
    if name not in top:
        return Quantity()
    entry = mapping(top[name], name, ("columns",), ("unit", "counts"))
    counts = finite(entry.get("counts", 1.0), f"{name}.counts")
    if not counts:
        raise EntryError(f"{name}.counts is 0: how many counts make up one unit?")
    columns = _three(entry["columns"], f"{name}.columns", "columns x, y, z")
    return Quantity(tuple(map(str, columns)), _unit(entry, name, units, usual) / counts)


def _unit(
    entry: Mapping[str, Any], name: str, units: Mapping[str, float], usual: str | None
) -> float:
    unit = entry.get("unit", usual)
    if unit not in [*units]:
        said = "missing" if unit is None else f"'{unit}'"
        raise EntryError(f"{name}.unit is {said}: allowed are {', '.join(units)}")
    return units[unit]


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


COMMENT = "#"
"""Lines that begin with it are skipped."""

EMPTY = ("", "nan", "NaN", "NA", "null")
"""Cells without a value: the stream has no sample in this row."""


def read_csv(
    path: Path,  # Table with a header line
    columns: ColumnMap,  # What its columns mean
) -> FlightLog:
    """Read a table.

    A row gives a sample of the rates if it has all three, one of the actuators if it has any
    channel, and so on: streams of different rates fit into one table with empty cells.

    Raises
    ------
    ImportLogError
        If it cannot be read, a column is missing, a cell is no number, or there are no samples.
    """
    findings = Findings()
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            t_ns, table = _read_table(file, columns, findings)
        streams = _streams(t_ns, table, columns)
    except OSError as error:
        raise ImportLogError(f"table '{path}' cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ImportLogError(f"table '{path}' is not text in UTF-8") from None
    except (csv.Error, EntryError) as error:
        raise ImportLogError(f"table '{path}': {error}") from None
    if not columns.force.columns:
        findings.doubt("there is no accelerometer: ay and az are zero")
    findings.say(
        f"units and axes from the column map: rates in body axes {columns.axes}, times "
        f"{columns.rates.factor:.6g} to rad/s"
    )
    findings.assume(
        "the stamp of a row is that of all its values, unfiltered; the table does not say when it "
        "flew"
    )
    return FlightLog(
        path,
        "table",
        streams,
        tuple(columns.channels.values()),
        findings,
        convention=columns.axes,
        lever_arm=columns.lever_arm,
    )


def _streams(t_ns: TimeArray, table: FloatArray, columns: ColumnMap) -> dict[str, Stream]:
    """Return the streams of a table whose rows follow each other in time."""
    steps = np.diff(t_ns)
    back, ahead = int((steps < 0).sum()), int((steps > 0).sum())
    if len(t_ns) > 1 and back >= ahead:
        raise EntryError(
            f"the time goes on in {ahead} rows and back in {back}: sort the rows by their time"
        )

    def part(names: Sequence[str]) -> FloatArray:
        return table[:, [columns.columns.index(name) - 1 for name in names]]

    def stream(what: str, names: Sequence[str], values: FloatArray, some: Any = np.all) -> Stream:
        there = some(np.isfinite(part(names)), axis=1)
        if not there.any():
            raise EntryError(f"it has no {what}: columns {', '.join(names)} are empty")
        return Stream("table", t_ns, values).chosen(there)

    rates, force, speed = columns.rates, columns.force, columns.airspeed
    measured = part(force.columns) * force.factor if force.columns else None
    both = gyro_and_force(part(rates.columns) * rates.factor, measured)
    channels = [*columns.channels]
    streams = {
        "rates": stream("rates", rates.columns, both),
        "actuators": stream("actuators", channels, part(channels), np.any),
    }
    if speed.columns:
        values = part(speed.columns)[:, 0] * speed.factor
        streams["airspeed"] = stream("airspeed", speed.columns, values)
    return streams


def _read_table(
    file: Iterator[str], columns: ColumnMap, findings: Findings
) -> tuple[TimeArray, FloatArray]:
    """Return the stamps, ns, and the columns of the map but the first, NaN where empty."""
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
    places = [header.index(name) for name in columns.columns]
    t_ns, values, short = [], [], []
    for line, cells in rows:
        if len(cells) <= max(places):
            short.append(line)
            continue
        t_ns.append(_stamp(line, cells[places[0]], columns.time_ns))
        values.append([_number(line, cells[place]) for place in places[1:]])
    if not values:
        raise EntryError("it has no complete row below its header")
    if short:
        findings.doubt(
            f"{len(short)} rows have too few cells and were left out, the first in line {short[0]}"
        )
    return np.array(t_ns, dtype=np.int64), np.array(values)


def _stamp(line: int, cell: str, unit_ns: Decimal) -> int:
    """Return a time, ns: decimals keep the nanoseconds of one since 1970, a float does not."""
    where = f"line {line}: the time is '{cell}'"
    try:
        t_ns = Decimal(cell) * unit_ns
        if 0 <= t_ns < LATEST_NS:
            return int(t_ns.to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise EntryError(f"{where}, which is no number") from None
    raise EntryError(
        f"{where}: a stamp holds 0 to {LATEST_NS // NS_PER_S} s; shift the column, or say its "
        "unit in the column map"
    )


def _number(line: int, cell: str) -> float:
    try:
        return float("nan" if cell in EMPTY else cell)
    except ValueError:
        raise EntryError(f"line {line}: '{cell}' is no number") from None
