# SPDX-License-Identifier: Apache-2.0
"""The yardsticks themselves: the output-error fit, the rival filters, the sums of the tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("padasip")

import accuracy_report
import adaptive_filters
import campaigns
import cases
import output_error
from excerpts import excerpt

from uav_ident_ros.identification.prediction import SELECTIONS
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.offline.run import run_over
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.plant import PlantFlight, fly
from uav_ident_ros.simulation.recording import parameters
from uav_ident_ros.simulation.vehicles import vehicle

STRUCTURE = STRUCTURES["throttle_coupled"]
PAPER = {"structure": STRUCTURE.name}
AMPLITUDES = {"de": 0.25, "dr": 0.35, "da": 0.25, "dth": 0.3}
"""Large enough to move the rate products too."""


@pytest.fixture(scope="module")
def flight() -> Flight:
    segments = (Segment("multisine", amplitudes=AMPLITUDES, seed=1),)
    return fly(PlantFlight(vehicle("small_uav"), segments, 40.0, rate=200.0, max_step=2.5e-3))


def case_of(flight: Flight, **sensors: Any) -> cases.Case:
    m = measure(flight, Sensors(**sensors), seed=1)
    return cases.Case(
        "test", 1, parameters(m), m.imu_t_ns, m.imu_log_ns, m.rates, m.specific_force,
        m.actuator_t_ns, m.actuator_log_ns, m.actuators, m.true_rates, flight,
    )  # fmt: skip


def test_the_simulated_windows_are_the_plants_own(flight: Flight) -> None:
    case = case_of(flight)
    blocks = output_error.grid_blocks(case, case.settings(PAPER))
    windows = output_error.cut_windows(blocks, -np.inf, np.inf)
    truth = cases.truth_in(STRUCTURE, flight)[:, :, None, None]
    path = output_error.simulate(truth, windows.x[0][:, None], windows)
    assert windows.x.shape == (201, 3, 40)
    assert np.abs(path[:, :, 0] - windows.x).max() < 1e-6


def test_output_error_recovers_the_truth_without_noise(flight: Flight) -> None:
    case = case_of(flight)
    truth = cases.truth_in(STRUCTURE, flight)
    found = output_error.fit(case, case.settings(PAPER), [0.6 * truth])
    mask = STRUCTURE.mask
    # The prior pulls the rate products by its own small weight.
    assert np.abs(found - truth)[mask].max() < 1e-3 * np.abs(truth).max()
    assert not found[~mask].any()


def test_output_error_is_not_biased_by_noise(flight: Flight) -> None:
    case = case_of(flight, gyro_noise=0.05)
    truth = cases.truth_in(STRUCTURE, flight)
    found = output_error.fit(case, case.settings(PAPER), [0.6 * truth], part=1.0)
    for name in cases.DOMINANT:
        where = STRUCTURE.index(name)
        assert found[where] == pytest.approx(truth[where], rel=0.03)


def test_output_error_keeps_fixed_coefficients(flight: Flight) -> None:
    case = case_of(flight)
    settings = case.settings(cases.MODELS["+ constant"])
    structure = STRUCTURES["augmented"]
    found = output_error.fit(case, settings, [cases.truth_in(structure, flight)])
    assert not found[:, structure.regressors.index("ay") :].any()


def test_the_rival_filter_learns_from_the_same_regressors(flight: Flight) -> None:
    case = case_of(flight)
    recorder = adaptive_filters.RegressionRecorder(STRUCTURE.mask.shape)
    cases.identify(case, PAPER, lambda *_: recorder)
    found = adaptive_filters.run_filter("RLS", 0.998, recorder, STRUCTURE.mask)
    truth = cases.truth_in(STRUCTURE, flight)
    assert len(found) == len(recorder.y)
    assert np.abs(found[-1] - truth).max() < 0.02 * np.abs(truth).max()


def test_a_perfect_model_scores_near_100_against_the_noise_free_rates(flight: Flight) -> None:
    case = case_of(flight, gyro_noise=0.1)
    settings = case.settings(PAPER)
    track = cases.constant_track(case, settings, cases.truth_in(STRUCTURE, flight))
    fits = cases.score(case, track)
    assert (fits.truth > 95.0).all()
    assert (fits.model < fits.truth).all()
    assert (fits.hold < 0.0).all()


def test_the_benchmark_scores_a_recorded_flight_as_replay_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cases, "RECORDED", tmp_path)
    excerpt(tmp_path / "flight", 15.0, "pulses")
    values = {"estimator": "least_squares"}
    case = cases.recorded("flight")
    fits = cases.score(case, cases.identify(case, values))
    run = run_over(tmp_path / "flight", {**case.parameters, **values})
    replayed = run.score()[cases.LAST_PART]
    assert set(SELECTIONS) >= {cases.LAST_PART}
    np.testing.assert_allclose(fits.model, replayed.model, rtol=1e-9)
    np.testing.assert_allclose(fits.measured_force, replayed.measured_force, rtol=1e-9)


def test_coverage_counts_what_lies_within_sigma() -> None:
    shape = STRUCTURES["augmented"].mask.shape
    errors = np.full((10, *shape), 1.5)
    errors[:6] = 0.5
    results = [
        {"coefficients": e.tolist(), "sigma": np.ones(shape).tolist(), "truth": np.zeros(shape)}
        for e in errors
    ]
    assert "within 1 sigma 60.0 ± 15.5 %, 2 sigma 100.0 ± 0.0 %" in campaigns._coverage_line(
        results
    )


def cell(flight: str, method: str, fit: float, hold: float = 0.0) -> dict[str, Any]:
    return {
        "flight": flight, "seed": 1, "structure": "+ ay, az", "method": method,
        "model": (fit,) * 3, "truth": (float("nan"),) * 3, "hold": (hold,) * 3,
        "measured_force": (float("nan"),) * 3, "coefficient_error": float("nan"), "seconds": 1.0,
    }  # fmt: skip


def test_the_table_averages_and_names_the_worst_cell() -> None:
    cells = [
        cell("c172p_calm", "instrumental_variable", 80.0),
        cell("c172p_calm", "output error", 82.0),
        cell("t37_calm", "instrumental_variable", -300.0),
        cell("t37_calm", "output error", 70.0),
        cell("t37_calm", "padasip NLMS 0.01", 10.0),
        cell("t37_calm", "padasip NLMS 0.5", 20.0),
    ]
    text = accuracy_report.table(cells)
    assert "NLMS 0.5" in text
    assert "NLMS 0.01" not in text
    # (80 - 50) / 2 with the one flight's three cells clipped; then -2 and -120.
    assert any("15.0 ( 3)" in line for line in text.splitlines())
    assert any("-61.0  -120.0  t37_calm p" in line for line in text.splitlines())
