# SPDX-License-Identifier: Apache-2.0
"""Tables (`.csv`) with one row per instant: columns as a column map explains them."""

from __future__ import annotations

import csv
import difflib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

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
from uav_ident_ros.import_logs.stamps import LATEST_NS, NS_PER_S

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
    t_ns, table = _read_table(path, columns, findings)
    steps = np.diff(t_ns)
    back, ahead = int((steps < 0).sum()), int((steps > 0).sum())
    if len(t_ns) > 1 and back >= ahead:
        raise ImportLogError(
            f"table '{path}': the time goes on in {ahead} rows and back in {back}: sort the rows "
            "by their time"
        )
    part = {name: table[:, i] for i, name in enumerate(columns.columns[1:])}

    def stream(
        what: str, names: Sequence[str], more: Sequence[str] = (), some: Any = np.all
    ) -> Stream:
        values = np.column_stack([part[name] for name in (*names, *more)])
        there = some(np.isfinite(values[:, : len(names)]), axis=1)
        if not there.any():
            raise ImportLogError(
                f"table '{path}' has no {what}: columns {', '.join(names)} are empty"
            )
        return Stream("table", t_ns, values).chosen(there)

    rates = stream("rates", columns.rates, columns.force)
    if not columns.force:
        findings.lost.append("there is no accelerometer: ay and az are zero")
    gyro = rates.values[:, :3] * columns.rates_factor
    force = rates.values[:, 3:] * columns.force_factor if columns.force else None
    streams = {
        "rates": replace(rates, values=gyro_and_force(gyro, force)),
        "actuators": stream("actuators", [*columns.channels], some=np.any),
    }
    if columns.airspeed:
        speed = stream("airspeed", [columns.airspeed])
        streams["airspeed"] = replace(speed, values=speed.values[:, 0] * columns.airspeed_factor)
    findings.read.append(
        f"units and axes from the column map: rates in body axes {columns.axes}, times "
        f"{columns.rates_factor:.6g} to rad/s"
    )
    findings.assumed.append(
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


def _read_table(path: Path, columns: ColumnMap, findings: Findings) -> tuple[TimeArray, FloatArray]:
    """Return the stamps, ns, and the columns of the map but the first, NaN where empty."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = _rows(file, columns.delimiter)
            _, header = next(rows, (0, []))
            places = _places(path, [cell.strip() for cell in header], columns)
            return _convert(path, rows, places, columns, findings)
    except OSError as error:
        raise ImportLogError(f"table '{path}' cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ImportLogError(f"table '{path}' is not text in UTF-8") from None
    except csv.Error as error:
        raise ImportLogError(f"table '{path}' is no table: {error}") from None


def _rows(file: Iterator[str], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and cells of each row, without comments and empty lines."""
    reader = csv.reader(file, delimiter=delimiter)
    for cells in reader:
        if any(cells) and not cells[0].lstrip().startswith(COMMENT):
            yield reader.line_num, cells


def _places(path: Path, header: list[str], columns: ColumnMap) -> list[int]:
    """Return the position of every column of the map."""
    if not header:
        raise ImportLogError(f"table '{path}' is empty: a header line is needed")
    for name in columns.columns:
        if name not in header:
            near = difflib.get_close_matches(name, header, n=1)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            raise ImportLogError(
                f"table '{path}' has no column '{name}'{hint}; it has {', '.join(header)}"
            )
    return [header.index(name) for name in columns.columns]


def _convert(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    places: list[int],
    columns: ColumnMap,
    findings: Findings,
) -> tuple[TimeArray, FloatArray]:
    """Turn the cells into numbers."""
    t_ns: list[int] = []
    values: list[list[float]] = []
    short: list[int] = []
    widest = max(places)
    for line, cells in rows:
        if len(cells) <= widest:
            short.append(line)
            continue
        # Decimals keep the nanoseconds of a time since 1970, which a float does not.
        t_ns.append(_stamp(path, line, cells[places[0]], columns))
        values.append([_number(path, line, cells[place]) for place in places[1:]])
    if not values:
        raise ImportLogError(f"table '{path}' has no complete row below its header")
    if short:
        findings.lost.append(
            f"{len(short)} rows have too few cells and were left out, the first in line {short[0]}"
        )
    return np.array(t_ns, dtype=np.int64), np.array(values)


def _stamp(path: Path, line: int, cell: str, columns: ColumnMap) -> int:
    where = f"table '{path}', line {line}: the time is '{cell.strip()}'"
    try:
        t_ns = Decimal(cell.strip()) * columns.time_ns
        if not 0 <= t_ns < LATEST_NS:
            raise ImportLogError(
                f"{where}: a stamp holds 0 to {LATEST_NS // NS_PER_S} s; shift the column, or say "
                "its unit in the column map"
            )
        return int(t_ns.to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise ImportLogError(f"{where}, which is no number") from None


def _number(path: Path, line: int, cell: str) -> float:
    text = cell.strip()
    if text in EMPTY:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        raise ImportLogError(f"table '{path}', line {line}: '{text}' is no number") from None
