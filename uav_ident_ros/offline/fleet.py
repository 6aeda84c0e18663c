# SPDX-License-Identifier: Apache-2.0
"""The table of many replayed flights, with pooled coefficients and changes of each aircraft.

A flight's estimate is its true value plus an error with the sigma of that flight. The true values
scatter from flight to flight with loading, air and speed (random-effects model of DerSimonian and
Laird 1986). A change is found by the generalised likelihood ratio: it compares the mean of the last
flights, for every number of them, with that of the flights before (Siegmund and Venkatraman 1995).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import uav_ident_ros
from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.bags.writing import whole
from uav_ident_ros.commandline import USABLE
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES, FloatArray
from uav_ident_ros.offline.job import VERDICTS, Outcome, optional
from uav_ident_ros.offline.tables import Number, Row, Table, duration_of

CSV_FILE = "flights.csv"
PARQUET_FILE = "flights.parquet"


@dataclass(frozen=True)
class FlightRow:
    """One coefficient of one flight, with the columns of docs/fleets.md.

    A flight without a result has one row, without a coefficient.
    """

    aircraft: str
    flight: str
    start_ns: int = 0
    duration: float = 0.0
    verdict: str = ""
    reason: str = ""
    structure: str = ""
    coefficient: str = ""
    value: float | None = None
    sigma: float | None = None  # Zero if fixed
    fit_p: float | None = None
    fit_q: float | None = None
    fit_r: float | None = None
    hold_p: float | None = None
    hold_q: float | None = None
    hold_r: float | None = None
    bag: str = ""
    bag_hash: str = ""
    settings_hash: str = ""
    version: str = uav_ident_ros.__version__


def arrow() -> tuple[Any, Any]:
    """Return the package pyarrow and the schema of the table; raises `BagError`."""
    pyarrow, _, _ = map(optional, ("pyarrow", "pyarrow.csv", "pyarrow.parquet"))
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
        "duration": duration_of(summary),
        "structure": summary["structure"],
    }
    for name, entry in summary["coefficients"].items():
        yield FlightRow(**common, coefficient=name, **entry)


def write_flights(folder: Path, rows: Sequence[FlightRow]) -> list[Path]:
    """Write the table as CSV and as Parquet; return the files; raises `BagWriteError`."""
    pa, schema = arrow()
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema)
    files = {folder / CSV_FILE: pa.csv.write_csv, folder / PARQUET_FILE: pa.parquet.write_table}
    for path, write in files.items():
        with whole(path) as part:
            write(table, part)
    return [*files]


def read_flights(path: Path) -> list[FlightRow]:
    """Read a table of flights, CSV or Parquet, or the folder of one; raises `BagError`."""
    pa, schema = arrow()
    path = path / CSV_FILE if path.is_dir() else path
    if not path.exists():
        raise BagError(
            f"'{path}' cannot be read: there is no such file; replay of several bags writes it"
        )
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


# --- pooled flights -------------------------------------------------------------------------------


LIMIT = 4.8723
"""Deviation from which a coefficient has changed, in its standard deviations: one false alarm in
100,000 tests, or in ten fleets of 60 flights with 150 coefficients in all. The mean number of tests
between false alarms is ``sqrt(2 pi) exp(b^2 / 2) / (b I)`` for a limit ``b`` with ``I``, the
integral of ``x nu(x)^2``, 0.735 (Siegmund and Venkatraman 1995)."""

BASELINE = 12
"""Least number of flights to estimate the scatter from: its relative standard deviation is then a
fifth."""

RECENT = 40
"""Number of last flights in which a change is searched: a slow one is found earlier."""

CLEAR = 3.0
"""Median t-ratio over the flights from which a coefficient is tested for changes."""


class Pooled(NamedTuple):
    """A pooled coefficient of an aircraft."""

    # value, sigma: Mean over the flights and its standard deviation
    value: float
    sigma: float
    scatter: float  # Standard deviation of the true values from flight to flight
    flights: int  # Number of pooled flights

    @property
    def next_sigma(self) -> float:
        """Standard deviation of the true value in the next flight."""
        return math.hypot(self.sigma, self.scatter)


def weighted(values: FloatArray, sigmas: FloatArray, scatter: float = 0.0) -> tuple[float, float]:
    """Return the mean of values (k,), weighted by their variances, and its standard deviation."""
    weight = 1.0 / (sigmas**2 + scatter**2)
    return float((weight * values).sum() / weight.sum()), float(weight.sum()) ** -0.5


def pool(values: FloatArray, sigmas: FloatArray) -> Pooled:
    """Pool the estimates of some flights, (k,) each, every sigma positive."""
    mean, sigma = weighted(values, sigmas)
    excess = float((((values - mean) / sigmas) ** 2).sum()) - (len(values) - 1)
    scale = sigma**-2 - float((sigmas**-4).sum()) * sigma**2
    scatter = math.sqrt(max(excess / scale, 0.0)) if scale > 0.0 else 0.0
    return Pooled(*weighted(values, sigmas, scatter), scatter, len(values))


def is_clear(values: FloatArray, sigmas: FloatArray) -> bool:
    """Whether the median t-ratio reaches `CLEAR`; NaN for flights without the coefficient."""
    return bool(np.nanmedian(np.abs(values) / sigmas) >= CLEAR)


@dataclass(frozen=True)
class FleetFinding:
    """A change of a coefficient."""

    coefficient: str  # Name of the coefficient
    since: str  # First flight with the change
    named: str  # Flight at which the change became significant
    # before, now: Pooled values before the change, and since then
    before: float
    now: float
    lasting: bool  # Whether it lasted for several flights; otherwise one flight is an outlier

    @property
    def text(self) -> str:
        """Text of the finding."""
        change = f"{self.before:+.4g} to {self.now:+.4g}"
        if self.before:
            change += f" ({100.0 * (self.now / self.before - 1.0):+.0f} %)"
        if self.lasting:
            return (
                f"{self.coefficient} has changed since {self.since}: {change}; certain at "
                f"{self.named}"
            )
        return f"{self.coefficient} of {self.since} stands out: {change}"


def standard(deviation: float, freedom: int) -> float:
    """Return the normal deviate of the same probability as one of Student's t (Wallace 1959)."""
    size = math.sqrt(freedom * math.log1p(deviation**2 / freedom))
    return math.copysign(size * (8 * freedom + 1) / (8 * freedom + 3), deviation)


def changes(
    coefficient: str, flights: Sequence[str], values: FloatArray, sigmas: FloatArray
) -> list[FleetFinding]:
    """Return the changes of a coefficient; (k,) each, in the order of the flights."""
    kept: list[int] = []
    found: list[FleetFinding] = []
    for k in range(len(values)):
        kept.append(k)
        begins = range(max(BASELINE, len(kept) - RECENT), len(kept))
        off = {begin: _deviation(values, sigmas, kept[:begin], kept[begin:]) for begin in begins}
        begin = max(off, key=off.__getitem__, default=0)
        if not off or off[begin] <= LIMIT:
            continue
        recent, before = kept[begin:], kept[:begin]
        alone = found[-1] if found and not found[-1].lasting else None
        if len(recent) == 1 and alone is not None and alone.since == flights[k - 1]:
            found.pop()  # two in a row: the outlier was the beginning of a change
            recent = [k - 1, k]
        then, now = (pool(values[which], sigmas[which]).value for which in (before, recent))
        lasting, since = len(recent) > 1, flights[recent[0]]
        found.append(FleetFinding(coefficient, since, flights[k], then, now, lasting))
        # an outlier is left out; a lasting change begins a new baseline
        kept = recent if lasting else kept[:-1]
    return found


def _deviation(values: FloatArray, sigmas: FloatArray, before: list[int], now: list[int]) -> float:
    """Return the deviation of some flights from the baseline before, in standard deviations."""
    usual = pool(values[before], sigmas[before])
    mean, sigma = weighted(values[now], sigmas[now], usual.scatter)
    off = (mean - usual.value) / math.hypot(usual.sigma, sigma)
    return abs(standard(off, len(before) - 1))


@dataclass(frozen=True)
class FlownAircraft:
    """An aircraft and its flights."""

    # name, structure: The aircraft, and the structure of its models
    name: str
    structure: str
    flights: tuple[str, ...]  # Flights with a usable model, in the order of their time
    # values, sigmas: Values and standard deviations of each coefficient in these flights, (k,);
    # NaN for flights without it
    values: Mapping[str, FloatArray]
    sigmas: Mapping[str, FloatArray]
    pooled: Mapping[str, Pooled]  # Coefficients pooled since they last changed
    findings: tuple[FleetFinding, ...]  # Changes and outliers
    unusable: tuple[tuple[str, str], ...]  # Flights without a usable model, and the reasons

    @property
    def main(self) -> list[str]:
        """Names of the coefficients with a chart: well known ones, control derivatives first."""
        clear = [name for name in self.pooled if is_clear(self.values[name], self.sigmas[name])]
        return sorted(clear, key=lambda name: name.rpartition("/")[2] not in INPUTS)

    @property
    def table(self) -> Table:
        """The pooled coefficients."""
        rows = []
        for name, p in self.pooled.items():
            sigmas = [Number(sigma, ".2g") for sigma in (p.sigma, p.scatter, p.next_sigma)]
            rows.append(Row(name, [Number(p.value), *sigmas, Number(p.flights, "d")]))
        head = ("coefficient", "pooled", "sigma", "scatter", "sigma of the next flight", "flights")
        return Table(f"Pooled, SI, structure {self.structure}", head, rows)

    def coefficient_set(self) -> CoefficientSet:
        """Return the pooled coefficients with the sigmas of the next flight.

        The sigma of a coefficient that no flight has is infinite.
        """
        structure = STRUCTURES[self.structure]
        values = np.zeros(structure.mask.shape)
        sigma = np.where(structure.mask, np.inf, 0.0)
        for name, pooled in self.pooled.items():
            values[structure.index(name)] = pooled.value
            sigma[structure.index(name)] = pooled.next_sigma
        return CoefficientSet(self.structure, values, sigma)


def fleet_of(rows: Iterable[FlightRow]) -> list[FlownAircraft]:
    """Return every aircraft of a table of flights, by name and structure.

    An aircraft whose models have several structures occurs once for each.
    """
    one_flight = attrgetter("start_ns", "flight", "bag")
    ordered = sorted(rows, key=lambda row: (row.aircraft, *one_flight(row)))
    fleet = []
    for name, flights in groupby(ordered, key=attrgetter("aircraft")):
        unusable: list[tuple[str, str]] = []
        usable: dict[str, list[list[FlightRow]]] = {}
        seen: Counter[str] = Counter()
        for _, own in groupby(flights, key=one_flight):
            first, *others = own
            seen[flight := first.flight] += 1
            if seen[flight] > 1:  # names are unique in a table, not in several
                flight = f"{flight}_{seen[flight]}"
                first = replace(first, flight=flight)
            if first.verdict == VERDICTS[USABLE]:
                usable.setdefault(first.structure, []).append([first, *others])
            else:
                unusable.append((flight, f"{first.verdict}: {first.reason}".rstrip(": ")))
        fleet += [
            _judged(name, structure, usable.get(structure, []), tuple(unusable))
            for structure in sorted(usable) or [""]
        ]
    return fleet


def _judged(
    name: str,
    structure: str,
    flights: Sequence[Sequence[FlightRow]],  # The usable ones, in the order of their time
    unusable: tuple[tuple[str, str], ...],
) -> FlownAircraft:
    """Pool the flights of an aircraft, and find the changes."""
    names = tuple(rows[0].flight for rows in flights)
    values: dict[str, FloatArray] = {}
    sigmas: dict[str, FloatArray] = {}
    for k, row in ((k, row) for k, rows in enumerate(flights) for row in rows):
        if row.value is not None and row.sigma:  # neither fixed nor unknown
            for kept, number in ((values, row.value), (sigmas, row.sigma)):
                kept.setdefault(row.coefficient, np.full(len(flights), np.nan))[k] = number
    pooled: dict[str, Pooled] = {}
    findings: list[FleetFinding] = []
    for coefficient in values:
        known = np.flatnonzero(np.isfinite(values[coefficient]))
        value, sigma = values[coefficient][known], sigmas[coefficient][known]
        given = [names[k] for k in known]
        new = changes(coefficient, given, value, sigma) if is_clear(value, sigma) else []
        findings += new
        begin = max((given.index(f.since) for f in new if f.lasting), default=0)
        single = {f.since for f in new if not f.lasting}
        chosen = [k for k in range(begin, len(given)) if given[k] not in single]
        pooled[coefficient] = pool(value[chosen], sigma[chosen])
    return FlownAircraft(name, structure, names, values, sigmas, pooled, tuple(findings), unusable)
