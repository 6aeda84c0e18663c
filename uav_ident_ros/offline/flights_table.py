# SPDX-License-Identifier: Apache-2.0
"""The results of many replays as one table: a row for each flight and coefficient."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import uav_ident_ros
from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.bags.writing import BagWriteError
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.offline.evidence import FIT_WINDOWS
from uav_ident_ros.offline.job import Outcome
from uav_ident_ros.offline.status import NO_RESULT, NOT_USABLE, USABLE

CSV_FILE = "flights.csv"
PARQUET_FILE = "flights.parquet"

VERDICTS = {USABLE: "usable", NOT_USABLE: "not usable", NO_RESULT: "no result"}
"""Words for the status of a replay."""


@dataclass(frozen=True)
class FlightRow:
    """One coefficient of one flight; of a flight without a result there is one row without any."""

    # aircraft, flight: The aircraft, and the name of the flight
    aircraft: str
    flight: str
    start_ns: int = 0  # Message time of the first tick, ns; 0 if there is none
    duration: float = 0.0  # Time from the first to the last tick, s
    # verdict, reason: ``usable``, ``not usable`` or ``no result``, and why
    verdict: str = ""
    reason: str = ""
    # structure, coefficient: Structure of the model and name of the coefficient
    structure: str = ""
    coefficient: str = ""
    # value, sigma: Its value and standard deviation, SI; a sigma of zero is that of a fixed one
    value: float | None = None
    sigma: float | None = None
    # fit_p, fit_q, fit_r, hold_p, hold_q, hold_r: Prediction fit over the last 40 % of the flight,
    # and that of holding the rates, percent
    fit_p: float | None = None
    fit_q: float | None = None
    fit_r: float | None = None
    hold_p: float | None = None
    hold_q: float | None = None
    hold_r: float | None = None
    # bag, bag_hash, settings_hash, version: The bag, SHA-256 of its files and of the settings,
    # version of the package
    bag: str = ""
    bag_hash: str = ""
    settings_hash: str = ""
    version: str = uav_ident_ros.__version__


def rows_of(outcome: Outcome) -> Iterator[FlightRow]:
    """Yield the rows of a replay."""
    job, summary = outcome.job, outcome.summary
    bag_hash, _, settings_hash = outcome.identity.partition(":")
    common: dict[str, Any] = {
        "aircraft": job.aircraft,
        "flight": job.name,
        "verdict": VERDICTS[outcome.status],
        "bag": str(job.bag),
        "bag_hash": bag_hash,
        "settings_hash": settings_hash,
    }
    if not summary:
        reason = outcome.warnings[-1].splitlines()[0] if outcome.warnings else ""
        yield FlightRow(**common, reason=reason)
        return
    fit = summary["prediction_fit"][FIT_WINDOWS]
    for name, key in (("fit", "model"), ("hold", "hold")):
        common |= {f"{name}_{axis}": value for axis, value in fit[key].items()}
    common |= {
        "start_ns": summary["first_tick_ns"],
        "duration": (summary["last_tick_ns"] - summary["first_tick_ns"]) * NS,
        "reason": summary["reason"] if outcome.status == NOT_USABLE else "",
        "structure": summary["structure"],
    }
    for name, entry in summary["coefficients"].items():
        yield FlightRow(**common, coefficient=name, value=entry["value"], sigma=entry["sigma"])


def write_flights(folder: Path, outcomes: Sequence[Outcome]) -> list[Path]:
    """Write the table as CSV, and as Parquet where pyarrow is installed; return the files.

    Raises
    ------
    BagWriteError
        If it cannot be written.
    """
    rows = [asdict(row) for outcome in outcomes for row in rows_of(outcome)]
    path, part = folder / CSV_FILE, folder / f".{CSV_FILE}.part"
    try:
        with part.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, [f.name for f in fields(FlightRow)])
            writer.writeheader()
            writer.writerows(rows)
        os.replace(part, path)
        return [path, *_write_parquet(folder / PARQUET_FILE, rows)]
    except OSError as error:
        raise BagWriteError(f"cannot write '{path}': {error.strerror}") from None


def _write_parquet(path: Path, rows: list[dict[str, Any]]) -> Iterator[Path]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        path.unlink(missing_ok=True)  # that of an earlier run would contradict the CSV
        return
    types = {"str": pyarrow.string(), "int": pyarrow.int64()}
    schema = pyarrow.schema(
        (f.name, types.get(str(f.type), pyarrow.float64())) for f in fields(FlightRow)
    )
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema), path)
    yield path


def read_flights(path: Path) -> list[FlightRow]:
    """Read a table of flights: CSV or Parquet, or the folder of one.

    Raises
    ------
    BagError
        If it cannot be read or is no such table.
    """
    if path.is_dir():
        path = path / CSV_FILE
    try:
        if path.suffix == ".parquet":
            from pyarrow import parquet

            return [FlightRow(**row) for row in parquet.read_table(path).to_pylist()]
        with path.open(encoding="utf-8", newline="") as file:
            return [_row(entry) for entry in csv.DictReader(file)]
    except ImportError:
        raise BagError(f"'{path}': Parquet needs pyarrow (pip install pyarrow)") from None
    except OSError as error:
        raise BagError(f"'{path}' cannot be read: {error.strerror or error}") from None
    except (TypeError, ValueError, KeyError, csv.Error) as error:
        raise BagError(f"'{path}' is no table of flights: {error}") from None


def _row(entry: dict[str, str]) -> FlightRow:
    kinds: dict[str, Any] = {"str": str, "int": int, "float": float}
    values: dict[str, Any] = {}
    for column in fields(FlightRow):
        text, kind = entry[column.name], str(column.type)
        if kind.endswith("| None"):
            values[column.name] = float(text) if text else None
        else:
            values[column.name] = kinds[kind](text)
    return FlightRow(**values)
