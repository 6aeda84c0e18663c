# SPDX-License-Identifier: Apache-2.0
"""Fleets: the table of flights, and the pooled estimates of many flights."""

import math
import re
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from excerpts import SECOND_NS
from programs import Capture, refusal

from uav_ident_ros.files.coefficients_file import load_coefficients
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.offline import fleet, fleet_command

NAMES = ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr")


# --- pooled estimates --------------------------------------------------------------------------


def synthetic(
    seed: int, loss: float = 0.0, flights: int = 60, scatter: float = 0.02, sigma: float = 0.02
) -> list[fleet.FlightRow]:
    """Return flights of an aircraft whose rudder loses a share `loss` per flight from the 30th."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(1, flights + 1):
        common = fleet.FlightRow(
            "aircraft", f"flight_{k:02d}", k * SECOND_NS, 300.0, "usable", structure="baseline"
        )
        for name in NAMES:
            true = 10.0 * (1.0 - loss * max(0, k - 29)) if name == "rdot/dr" else 10.0
            own = 10.0 * sigma * float(rng.uniform(0.7, 1.5))
            value = true + 10.0 * scatter * rng.standard_normal() + own * rng.standard_normal()
            rows.append(replace(common, coefficient=name, value=float(value), sigma=own))
    rng.shuffle(rows)  # type: ignore[arg-type]
    return rows


LATER = [pytest.param(seed, marks=pytest.mark.campaign) for seed in range(3, 10)]


@pytest.mark.parametrize("seed", [0, 1, 2, *LATER])
def test_only_the_weakening_rudder_is_named_within_eight_flights(seed: int) -> None:
    (aircraft,) = fleet.fleet_of(synthetic(seed, loss=0.02))
    first = aircraft.findings[0]
    assert first.coefficient == "rdot/dr"
    assert first.lasting
    assert 30 <= int(first.named.removeprefix("flight_")) <= 38
    assert first.now < first.before
    assert {finding.coefficient for finding in aircraft.findings} == {"rdot/dr"}
    (unchanged,) = fleet.fleet_of(synthetic(100 + seed))
    assert unchanged.findings == ()


def test_the_pooled_sigmas_cover_68_percent_of_the_true_values() -> None:
    inside, ahead = [], []
    for seed in range(40):
        (aircraft,) = fleet.fleet_of(synthetic(200 + seed, flights=20))
        for pooled in aircraft.pooled.values():
            inside.append(abs(pooled.value - 10.0) <= pooled.sigma)
            # true value of the next flight
            true = 10.0 + 0.2 * np.random.default_rng([seed, len(inside)]).standard_normal()
            ahead.append(abs(true - pooled.value) <= pooled.next_sigma)
    # one sigma covers 68 %; 240 draws give a share to three points
    assert statistics.fmean(inside) == pytest.approx(0.68, abs=0.09)
    assert statistics.fmean(ahead) == pytest.approx(0.68, abs=0.09)


def test_pooling_follows_dersimonian_and_laird() -> None:
    values, sigmas = np.array([1.0, 2.0, 4.0]), np.array([0.5, 0.5, 1.0])
    alike = fleet.pool(np.array([1.0, 1.1, 0.9]), sigmas)
    assert alike.scatter == 0.0
    assert alike.sigma == pytest.approx(1.0 / math.sqrt(4.0 + 4.0 + 1.0))
    # DerSimonian and Laird by hand: w = 4, 4, 1; mean 16/9; Q = 8.22; c = 9 - 33/9
    mean = 16.0 / 9.0
    q = 4.0 * (1.0 - mean) ** 2 + 4.0 * (2.0 - mean) ** 2 + (4.0 - mean) ** 2
    tau2 = (q - 2.0) / (9.0 - 33.0 / 9.0)
    weight = 1.0 / (sigmas**2 + tau2)
    found = fleet.pool(values, sigmas)
    assert found.scatter == pytest.approx(math.sqrt(tau2))
    assert found.value == pytest.approx((weight * values).sum() / weight.sum())
    assert found.sigma == pytest.approx(weight.sum() ** -0.5)
    assert found.next_sigma == pytest.approx(math.hypot(found.sigma, found.scatter))


@pytest.mark.parametrize(
    ("which", "off", "named", "lasting"),
    [(slice(25, 26), 6.0, "f25", False), (slice(25, None), 3.0, "f26", True)],
)
def test_an_outlying_flight_is_no_lasting_change_and_a_jump_is_one(
    which: slice, off: float, named: str, lasting: bool
) -> None:
    values = 10.0 + 0.2 * np.random.default_rng(6).standard_normal(40)
    values[which] += off
    (found,) = fleet.changes("pdot/da", [f"f{k}" for k in range(40)], values, np.full(40, 0.1))
    assert (found.since, found.named, found.lasting) == ("f25", named, lasting)
    assert found.text.startswith("pdot/da of f25 stands out: +") is not lasting
    assert found.now == pytest.approx(values[which].mean(), abs=0.3)


def test_the_limit_gives_one_false_alarm_in_100_000_flights() -> None:
    between = math.sqrt(2.0 * math.pi) * math.exp(fleet.LIMIT**2 / 2.0) / (0.735 * fleet.LIMIT)
    assert between == pytest.approx(100_000.0, rel=1e-3)
    # no flight is tested before the baseline is complete
    jump = np.array([10.0, *[100.0] * (fleet.BASELINE - 1)])
    assert fleet.changes("x", ["f"] * fleet.BASELINE, jump, np.ones(fleet.BASELINE)) == []


def test_student_deviates_convert_to_normal_ones_of_equal_probability() -> None:
    from scipy import stats

    for freedom in (11, 30):
        for deviation in (1.0, -3.0, 6.0):
            expected = stats.norm.isf(stats.t.sf(abs(deviation), freedom))
            assert abs(fleet.standard(deviation, freedom)) == pytest.approx(expected, rel=5e-3)
    assert fleet.standard(-3.0, 11) == -fleet.standard(3.0, 11)


def test_aircraft_and_structures_are_pooled_separately() -> None:
    rows = [replace(r, flight=r.flight.replace("01", "99")) for r in synthetic(1, flights=14)]
    other = [replace(row, aircraft="b", structure="augmented") for row in synthetic(2, flights=14)]
    mixed = [replace(row, aircraft="b") for row in synthetic(3, flights=14)]
    mixed = [replace(row, flight=f"old_{row.flight}") for row in mixed]
    failed = fleet.FlightRow("b", "broken", verdict="no result", reason="no bag")
    aircraft = fleet.fleet_of([*rows, *other, *mixed, failed])
    assert [(a.name, a.structure, len(a.flights)) for a in aircraft] == [
        ("aircraft", "baseline", 14), ("b", "augmented", 14), ("b", "baseline", 14)
    ]  # fmt: skip
    assert aircraft[0].flights[0] == "flight_99"  # ordered by time, not by name
    assert aircraft[1].unusable == (("broken", "no result: no bag"),)
    (alone,) = fleet.fleet_of([failed])
    assert alone.pooled == {}
    (several,) = fleet.fleet_of(replace(row, flight="flight") for row in rows)  # of several tables
    assert several.flights == ("flight", *(f"flight_{k}" for k in range(2, 15)))
    assert several.pooled == aircraft[0].pooled


def test_the_command_writes_page_and_coefficients(tmp_path: Path, capsys: Capture) -> None:
    fleet.write_flights(tmp_path, synthetic(0, loss=0.02))
    assert fleet_command.main([str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert re.search(r"change: rdot/dr has changed since flight_3\d: \+", printed)
    page = (tmp_path / "fleet.html").read_text()
    assert "rdot/dr has changed since" in page
    assert "<h3>rdot/dr</h3>" in page
    pooled = load_coefficients(tmp_path / "pooled_aircraft.yaml", "baseline")
    structure = STRUCTURES["baseline"]
    assert pooled.values[structure.index("pdot/p")] == pytest.approx(10.0, abs=0.2)
    assert 0.1 < pooled.sigma[structure.index("pdot/p")] < 0.4  # scatter of 0.2 and more
    assert np.isinf(pooled.sigma[structure.index("pdot/pq")])  # unknown in every flight

    fleet.write_flights(tmp_path, synthetic(0))
    table, output = str(tmp_path / fleet.CSV_FILE), str(tmp_path / "x")
    assert fleet_command.main([table, "--output", output]) == 0
    assert "change:" not in capsys.readouterr().out


@pytest.mark.parametrize("content", [None, "", "a,b\n1,2\n", "aircraft\nx\n"])
def test_invalid_table_is_refused(tmp_path: Path, capsys: Capture, content: str | None) -> None:
    path = tmp_path / "flights.csv"
    if content is not None:
        path.write_text(content)
    line = refusal(fleet_command.main, [str(path)], capsys)
    missing = " cannot be read: there is no such file; replay of several" if content is None else ""
    assert line.startswith("fleet: ") and f"flights.csv'{missing}" in line
