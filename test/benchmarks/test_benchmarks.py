# SPDX-License-Identifier: Apache-2.0
"""The yardsticks themselves: the output-error fit, the rival filters, the sums of the tables."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("scipy")

import cases
import output_error
from excerpts import excerpt

from uav_ident_ros.identification.prediction import SELECTIONS
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.offline.run import run_over
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.plant import PlantFlight, vehicle
from uav_ident_ros.simulation.recording import parameters

STRUCTURE = STRUCTURES["throttle_coupled"]
PAPER = {"structure": STRUCTURE.name}
AMPLITUDES = {"de": 0.25, "dr": 0.35, "da": 0.25, "dth": 0.3}
"""Large enough to move the rate products too."""


@pytest.fixture(scope="module")
def flight() -> Flight:
    segments = (Segment("multisine", amplitudes=AMPLITUDES, seed=1),)
    plan = PlantFlight(segments, 40.0, 200.0, vehicle=vehicle("small_uav"), max_step=2.5e-3)
    return plan.fly()


def case_of(flight: Flight, **sensors: Any) -> cases.Case:
    m = measure(flight, Sensors(**sensors), seed=1)
    return cases.Case(
        "test", 1, parameters(m), m.imu_t_ns, m.imu_log_ns, m.rates, m.specific_force,
        m.actuator_t_ns, m.actuator_log_ns, m.actuators, m.true_rates, flight,
    )  # fmt: skip


def test_output_error_recovers_the_truth_without_noise(flight: Flight) -> None:
    case = case_of(flight)
    truth = cases.truth_in(STRUCTURE, flight)
    found = output_error.fit(case, case.settings(PAPER), [0.6 * truth])
    mask = STRUCTURE.mask
    # The prior pulls the rate products by its own small weight.
    assert np.abs(found - truth)[mask].max() < 1e-3 * np.abs(truth).max()
    assert not found[~mask].any()


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
    # An offline fit has the forces; the paper's structure takes none.
    np.testing.assert_array_equal(fits.given_force, fits.measured_force)
    assert not np.isnan(fits.given_force).any()
    np.testing.assert_array_equal(cases.given_force(fits.model, np.full(3, np.nan)), fits.model)
