# SPDX-License-Identifier: Apache-2.0
"""The benchmarks: output-error fits, adaptive filters, flights, mutated files, sample path."""

import shutil
from dataclasses import replace
from pathlib import Path

import adaptive_filters
import cases
import flights
import fuzz
import numpy as np
import output_error
import pytest
import sample_walk
from excerpts import excerpt
from flying import plant_flight
from light_aircraft import TRUTH, LightFlight
from programs import Capture

from uav_ident_ros.identification.prediction import SELECTIONS
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES
from uav_ident_ros.offline.run import run_over
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure

STRUCTURE = STRUCTURES["throttle_coupled"]
PAPER = {"structure": STRUCTURE.name}
AMPLITUDES = {"de": 0.25, "dr": 0.35, "da": 0.25, "dth": 0.3}
"""Sufficient excitation of the rate products."""


@pytest.fixture(scope="module")
def flight() -> Flight:
    return plant_flight(40.0, segments=(Segment("multisine", amplitudes=AMPLITUDES, seed=1),))


def test_output_error_recovers_the_true_coefficients_without_noise(flight: Flight) -> None:
    case = cases.measured(measure(flight, Sensors(), seed=1))
    truth = cases.truth_in(STRUCTURE, flight)
    found = output_error.fit(case, case.settings(PAPER), [0.6 * truth])
    mask = STRUCTURE.mask
    # The weak prior leaves a small bias in the rate products.
    assert np.abs(found - truth)[mask].max() < 1e-3 * np.abs(truth).max()
    assert not found[~mask].any()


def test_recursive_least_squares_recovers_the_dominant_coefficients(flight: Flight) -> None:
    case = cases.measured(measure(flight, Sensors(gyro_noise=0.002), seed=1))
    track, recorder = adaptive_filters.recorded(case, PAPER)
    found = adaptive_filters.run_filter("RLS", adaptive_filters.RLS_FORGETTING, recorder)
    assert 0.9 * len(track.t_ns) < len(found) <= len(track.t_ns)
    for name in cases.DOMINANT:
        truth = cases.truth_in(STRUCTURE, flight)[STRUCTURE.index(name)]
        assert found[-1][STRUCTURE.index(name)] == pytest.approx(truth, rel=0.05), name


def test_the_benchmark_scores_a_recorded_flight_as_replay_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cases, "RECORDED", tmp_path)
    excerpt(tmp_path / "flight", 10.0, "pulses")
    values = {"estimator": "least_squares"}
    case = cases.recorded("flight")
    fits = cases.score(case, cases.identify(case, values))
    run = run_over(tmp_path / "flight", {**case.parameters, **values})
    replayed = run.score()[cases.LAST_PART]
    assert set(SELECTIONS) >= {cases.LAST_PART}
    np.testing.assert_allclose(fits.model, replayed.model, rtol=1e-9)
    np.testing.assert_allclose(fits.measured_force, replayed.measured_force, rtol=1e-9)
    # An offline fit has measured forces; the paper's structure has no force regressors.
    np.testing.assert_array_equal(cases.given_force(fits), fits.measured_force)
    assert not np.isnan(fits.measured_force).any()
    without = replace(fits, measured_force=np.full(3, np.nan))
    np.testing.assert_array_equal(cases.given_force(without), fits.model)


@pytest.mark.parametrize("name", flights.definitions())
def test_every_flight_definition_has_a_plan_and_a_consistent_rate(name: str) -> None:
    own = flights.definition(name)
    plan = flights.plan_of(own)
    assert plan.duration > 0.0 and own["description"] and "seed" in own
    assert plan.rate % flights.sensors_of(own).rate == 0.0


def test_flights_are_cached_by_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "CACHE", tmp_path)
    monkeypatch.setattr(flights, "WORTH_KEEPING", 0.0)
    first = flights.load("exact_convergence")
    (kept,) = tmp_path.iterdir()
    modified = kept.stat().st_mtime_ns
    second = flights.load("exact_convergence")
    assert kept.stat().st_mtime_ns == modified
    np.testing.assert_array_equal(first.rates, second.rates)
    other = flights.load("exact_convergence", seed=2)
    assert len(list(tmp_path.iterdir())) == 2
    assert np.any(other.rates != first.rates)


def test_the_cache_key_depends_on_the_flight_and_not_on_the_sensors() -> None:
    own = flights.definition("exact_gusts_10")
    assert flights.key_of(own) == flights.key_of({**own, "sensors": {}, "description": "x"})
    assert flights.key_of(own) != flights.key_of({**own, "delay": 0.01})
    assert flights.key_of(own) != flights.key_of(own, 7)


EXCITATION = Segment("multisine", amplitudes={"de": 0.03, "dr": 0.04, "da": 0.03})


def test_the_aircraft_has_its_declared_derivatives() -> None:
    """Found by regression of the noise-free accelerations and forces."""
    flight = LightFlight((EXCITATION,), 40.0).fly()
    p, q, r = flight.rates.T
    columns = {name: flight.extra[name] for name in ("beta", "alpha")}
    columns |= dict(zip(INPUTS, flight.extra["surfaces"].T, strict=True))
    columns |= {"p": p, "q": q, "r": r, "qr": q * r, "pr": p * r, "pq": p * q, "1": 1.0 + 0.0 * p}
    signals = np.column_stack([flight.angular_acceleration, flight.specific_force[:, 1:]])
    values = np.linalg.lstsq(np.column_stack([*columns.values()]), signals, rcond=None)[0]
    rows, places = ("pdot", "qdot", "rdot", "ay", "az"), [*columns]
    for name, value in TRUTH.items():
        row, column = name.split("/")
        found = values[places.index(column), rows.index(row)]
        assert found == pytest.approx(value, rel=0.1, abs=0.1), name


def test_the_path_of_a_sample_starts_at_the_feed_and_passes_the_stages(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(sample_walk, "LEARNING", 1.0)
    sample_walk.main([])
    *files, last = capsys.readouterr().out.splitlines()
    counts = [int(line.split()[0]) for line in files]
    assert last.startswith(f"{len(files)} files, {sum(counts)} functions ")
    names = [line.split()[1].removeprefix("identification/") for line in files]
    parts = ["messages/feed.py", "identifier.py", "samples.py", "regression.py", "supervision.py"]
    assert set(parts) <= set(names) and names[0] == parts[0]


COUNTS = {"ulg": 20, "bin": 20, "csv": 20, "bbl": 8, "mcap none": 8, "mcap lz4": 8, "mcap zstd": 8}
"""Number of files of each kind; `benchmarks/fuzz.py` uses thousands."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return fuzz.write_whole(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("kind", COUNTS)
def test_undamaged_files_read_in_full_and_mutated_ones_cause_no_crash(
    kind: str, whole: dict[str, Path], tmp_path: Path
) -> None:
    read = fuzz.read_bag if kind.startswith("mcap") else fuzz.read_log
    assert read(Path(shutil.copy(whole[kind], tmp_path))) == ("whole", "")
    outcomes = [fuzz.judge((kind, str(whole[kind]), s, str(tmp_path))) for s in range(COUNTS[kind])]
    failed = [outcome.printed for outcome in outcomes if outcome.result == "FAILED"]
    assert not failed, failed[0]
    assert {outcome.result for outcome in outcomes} <= {"whole", "with a loss", "refused"}
