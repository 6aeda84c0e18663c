# SPDX-License-Identifier: Apache-2.0
"""Tables (`.csv`) with one row per instant: columns as a column map explains them."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.files.strict_yaml import EntryError, meant
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.column_map import ColumnMap
from uav_ident_ros.import_logs.flight_log import (
    Findings,
    FlightLog,
    ImportLogError,
    Stream,
    gyro_and_force,
)
from uav_ident_ros.import_logs.stamps import LATEST_NS
from uav_ident_ros.messages.types import NS_PER_S

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
