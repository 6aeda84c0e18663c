# SPDX-License-Identifier: Apache-2.0
"""The table of many replayed flights, as CSV and as Parquet: a row for each coefficient of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import uav_ident_ros
from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.bags.writing import whole
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.offline.job import VERDICTS, Outcome

CSV_FILE = "flights.csv"
PARQUET_FILE = "flights.parquet"


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


def arrow() -> tuple[Any, Any]:
    """Return the package pyarrow and the columns as it writes them.

    Raises
    ------
    BagError
        If it is missing.
    """
    try:
        import pyarrow.csv
        import pyarrow.parquet
    except ImportError:
        raise BagError("a table of flights needs pyarrow: pip install pyarrow") from None
    kinds = {"str": pyarrow.string(), "int": pyarrow.int64()}
    named = [(f.name, kinds.get(str(f.type), pyarrow.float64())) for f in fields(FlightRow)]
    return pyarrow, pyarrow.schema(named)


def rows_of(outcome: Outcome) -> Iterator[FlightRow]:
    """Yield the rows of a replay."""
    job, summary = outcome.job, outcome.summary
    bag_hash, _, settings_hash = outcome.identity.partition(":")
    common: dict[str, Any] = {
        "aircraft": job.aircraft,
        "flight": job.name,
        "verdict": VERDICTS[outcome.status],
        "reason": outcome.reason,
        "bag": str(job.bag),
        "bag_hash": bag_hash,
        "settings_hash": settings_hash,
    }
    if not summary:
        yield FlightRow(**common)
        return
    for name, kind in (("fit", "model"), ("hold", "hold")):
        common |= {f"{name}_{axis}": value for axis, value in outcome.fit(kind).items()}
    common |= {
        "start_ns": summary["first_tick_ns"],
        "duration": (summary["last_tick_ns"] - summary["first_tick_ns"]) * NS,
        "structure": summary["structure"],
    }
    for name, entry in summary["coefficients"].items():
        yield FlightRow(**common, coefficient=name, **entry)


def write_flights(folder: Path, rows: Sequence[FlightRow]) -> list[Path]:
    """Write the table as CSV and as Parquet; return the files.

    Raises
    ------
    BagWriteError
        If it cannot be written.
    """
    pa, schema = arrow()
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema)
    files = {folder / CSV_FILE: pa.csv.write_csv, folder / PARQUET_FILE: pa.parquet.write_table}
    for path, write in files.items():
        with whole(path) as part:
            write(table, part)
    return [*files]


def read_flights(path: Path) -> list[FlightRow]:
    """Read a table of flights: CSV or Parquet, or the folder of one.

    Raises
    ------
    BagError
        If it cannot be read or is no such table.
    """
    pa, schema = arrow()
    path = path / CSV_FILE if path.is_dir() else path
    if not path.exists():
        raise BagError(f"'{path}' cannot be read: there is no such file")
    columns = pa.csv.ConvertOptions(column_types=schema, include_columns=schema.names)
    try:
        if path.suffix == ".parquet":
            table = pa.parquet.read_table(path, columns=schema.names)
        else:
            table = pa.csv.read_csv(path, convert_options=columns)
        return [FlightRow(**row) for row in table.to_pylist()]
    except OSError as error:
        raise BagError(f"'{path}' cannot be read: {error.strerror or error}") from None
    except (TypeError, pa.ArrowException) as error:
        raise BagError(f"'{path}' is no table of flights: {error}") from None
