# SPDX-License-Identifier: Apache-2.0
"""The estimators on plants of known truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flying import (
    AMPLITUDES,
    DOMINANT,
    errors,
    identify,
    linear_names,
    messages,
    plant_flight,
    run,
    settings,
    worst,
)

from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.rigid_body import product_coefficients
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.disturbance import ColouredNoise
from uav_ident_ros.simulation.flight import CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.vehicles import vehicle

STRUCTURE = "throttle_coupled"


def test_the_papers_law_converges_to_the_truth() -> None:
    # Persistent excitation wild enough to move the rate products too, no noise.
    amplitudes = {name: 3.0 * peak for name, peak in AMPLITUDES.items()}
    flight = plant_flight(150.0, segments=(Segment("multisine", amplitudes=amplitudes, seed=1),))
    _, found = identify(
        measure(flight, Sensors(gyro_noise=0.0), seed=1),
        structure=STRUCTURE,
        estimator="gradient",
        gradient__gains=(4.0,) * 12,
    )
    assert worst(errors(found, STRUCTURE, flight, STRUCTURES[STRUCTURE].names)) < 0.02


@pytest.mark.parametrize("estimator", ["least_squares", "instrumental_variable"])
def test_noise_free_coefficients_are_the_true_ones(estimator: str) -> None:
    flight = plant_flight(60.0)
    _, found = identify(
        measure(flight, Sensors(gyro_noise=0.0), seed=1), structure=STRUCTURE, estimator=estimator
    )
    assert worst(errors(found, STRUCTURE, flight, linear_names(flight))) < 0.005


@pytest.mark.parametrize("estimator", ["least_squares", "instrumental_variable"])
def test_noise_leaves_the_dominant_ones_within_five_percent(estimator: str) -> None:
    flight = plant_flight(60.0)
    _, found = identify(
        measure(flight, Sensors(gyro_noise=0.02), seed=1), structure=STRUCTURE, estimator=estimator
    )
    assert worst(errors(found, STRUCTURE, flight, DOMINANT)) < 0.05


def test_gusts_bias_least_squares_but_not_the_instruments() -> None:
    flight = plant_flight(80.0, gusts=ColouredNoise(1.0, 0.3))
    measurements = measure(flight, Sensors(gyro_noise=0.03), seed=1)
    error = {
        name: worst(
            errors(
                identify(measurements, structure=STRUCTURE, estimator=name)[1],
                STRUCTURE,
                flight,
                ("pdot/p", "pdot/da", "qdot/de"),
            )
        )
        for name in ("least_squares", "instrumental_variable")
    }
    assert error["instrumental_variable"] < 0.1
    assert error["least_squares"] > 2.0 * error["instrumental_variable"]


@pytest.mark.parametrize("estimator", ["least_squares", "instrumental_variable"])
def test_sigma_covers_the_error(estimator: str) -> None:
    """Pooled over a few flights in gusts; the campaign does it over hundreds."""
    ratios = []
    for seed in range(3):
        flight = plant_flight(45.0, gusts=ColouredNoise(0.3, 0.3), seed=seed)
        assert flight.coefficients is not None
        measurements = measure(flight, Sensors(gyro_noise=0.03), seed=seed)
        identifier = OnlineIdentifier(
            settings(measurements, structure=STRUCTURE, estimator=estimator)
        )
        last = run(identifier, messages(measurements))[-1]
        free = identifier.structure.mask
        ratios.append(np.abs(last.coefficients - flight.coefficients)[free] / last.sigma[free])
    pooled = np.concatenate(ratios)
    assert 0.5 < (pooled < 1.0).mean() < 0.95
    assert (pooled < 2.0).mean() > 0.85


def test_a_halved_control_derivative_is_followed_alone() -> None:
    name = "pdot/da"
    flight = plant_flight(
        60.0,
        changes=(CoefficientChange(45.0, {name: 0.5}),),
        gusts=ColouredNoise(0.3, 0.3),
    )
    measurements = measure(flight, Sensors(gyro_noise=0.02), seed=1)
    identifier = OnlineIdentifier(settings(measurements, structure=STRUCTURE))
    estimates = run(identifier, messages(measurements))
    t = np.array([e.t_ns - measurements.imu_t_ns[0] for e in estimates]) * 1e-9
    place = identifier.structure.index(name)
    before, after = estimates[np.searchsorted(t, 45.0)], estimates[np.searchsorted(t, 55.0)]
    truth = flight.coefficients_at(50.0)[place]
    assert abs(after.coefficients[place] / truth - 1.0) < 0.15
    for other in set(DOMINANT) - {name}:
        i = identifier.structure.index(other)
        moved = abs(after.coefficients[i] - before.coefficients[i])
        assert moved < max(0.1 * abs(before.coefficients[i]), 2.0 * before.sigma[i])


def test_known_inertias_fix_the_rate_products() -> None:
    flight = plant_flight(20.0)
    body = vehicle("small_uav").inertia
    assert body is not None
    _, found = identify(
        measure(flight, Sensors(gyro_noise=0.02), seed=1),
        structure=STRUCTURE,
        model__inertia=(body.ix, body.iy, body.iz, body.ixz),
    )
    np.testing.assert_array_equal(found[:, :5], product_coefficients(body))


def test_fixed_coefficients_stay_and_have_no_sigma() -> None:
    measurements = measure(plant_flight(20.0), Sensors(gyro_noise=0.02), seed=1)
    names = ("pdot/dth", "rdot/dth")
    identifier = OnlineIdentifier(
        settings(measurements, structure=STRUCTURE, fixed_coefficients=names)
    )
    last = run(identifier, messages(measurements))[-1]
    for name in names:
        place = identifier.structure.index(name)
        assert (last.coefficients[place], last.sigma[place]) == (0.0, 0.0)


def test_a_confident_start_is_kept_until_the_data_say_otherwise() -> None:
    flight = plant_flight(6.0)
    assert flight.coefficients is not None
    measurements = measure(flight, Sensors(gyro_noise=0.03), seed=1)
    sigma = np.where(STRUCTURES[STRUCTURE].mask, 0.01 * np.abs(flight.coefficients) + 1e-6, 0.0)
    warm = CoefficientSet(STRUCTURE, flight.coefficients, sigma)
    cold_error, warm_error = (
        worst(
            errors(
                run(
                    OnlineIdentifier(settings(measurements, structure=STRUCTURE), initial),
                    messages(measurements),
                )[-1].coefficients,
                STRUCTURE,
                flight,
                DOMINANT,
            )
        )
        for initial in (None, warm)
    )
    assert warm_error < 0.5 * cold_error
    assert warm_error < 0.05


def paper_settings(**changes: Any) -> dict[str, Any]:
    return {
        "structure": STRUCTURE,
        "estimator": "gradient",
        "filter__method": "backward_difference",
        "gradient__normalisation": "none",
        "gradient__gains": (10776.8,) * 5 + (3.282806,) * 6 + (0.001,),
        "model__leak_time": 0.0,
        **changes,
    }


def test_eulers_step_that_blows_up_says_so_and_stays_finite() -> None:
    wild = {name: 6.0 * peak for name, peak in AMPLITUDES.items()}
    flight = plant_flight(20.0, segments=(Segment("multisine", amplitudes=wild, seed=1),))
    measurements = measure(flight, Sensors(gyro_noise=0.02), seed=1)
    euler = OnlineIdentifier(settings(measurements, **paper_settings(gradient__step="euler")))
    estimates = run(euler, messages(measurements))
    assert all(np.isfinite(e.coefficients).all() for e in estimates)
    assert estimates[-1].state == "fault"
    assert "gradient.gains" in estimates[-1].reason
    guarded = OnlineIdentifier(settings(measurements, **paper_settings(gradient__step="guarded")))
    last = run(guarded, messages(measurements))[-1]
    assert np.isfinite(last.coefficients).all()
    assert last.state != "fault"


def test_reset_reproduces_the_first_run_to_the_bit() -> None:
    measurements = measure(plant_flight(15.0), Sensors(gyro_noise=0.02), seed=1)
    identifier = OnlineIdentifier(settings(measurements))
    first = run(identifier, messages(measurements))
    identifier.reset()
    second = run(identifier, messages(measurements))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.coefficients, b.coefficients)
        np.testing.assert_array_equal(a.sigma, b.sigma)
        np.testing.assert_array_equal(a.predicted_rates, b.predicted_rates)
        np.testing.assert_array_equal(a.fit, b.fit)


def test_inputs_that_move_together_are_named() -> None:
    class Tied(Segment):
        """Rudder and aileron in proportion, as behind an aileron-rudder interconnect."""

        def sample(self, t: np.ndarray) -> np.ndarray:
            u = super().sample(t)
            u[:, 1] = 0.8 * u[:, 2]
            return u

    together = measure(
        plant_flight(40.0, segments=(Tied("multisine", amplitudes=AMPLITUDES, seed=1),)),
        Sensors(gyro_noise=0.02),
        seed=1,
    )
    apart = measure(plant_flight(40.0), Sensors(gyro_noise=0.02), seed=1)
    tied, free = (identify(m, structure=STRUCTURE)[0] for m in (together, apart))
    assert ("pdot/dr", "pdot/da") in tied.collinear()
    assert ("rdot/dr", "rdot/da") in tied.collinear()
    assert not free.collinear()
    assert tied.excitation()[0] < 0.01 < 0.1 < free.excitation()[0]
    assert (free.excitation() <= 1.0).all()


def at_rest_and_last(forgetting_time: float) -> tuple[OnlineIdentifier, Flight, Estimate, Estimate]:
    """Rudder and throttle move for half a minute; then they rest, while the others go on."""
    still = {name: peak for name, peak in AMPLITUDES.items() if name in ("de", "da")}
    flight = plant_flight(
        70.0,
        segments=(
            Segment("multisine", duration=30.0, amplitudes=AMPLITUDES, seed=1),
            Segment("multisine", start=30.0, amplitudes=still, seed=2),
        ),
        gusts=ColouredNoise(0.3, 0.3),
    )
    measurements = measure(flight, Sensors(gyro_noise=0.02), seed=1)
    identifier = OnlineIdentifier(
        settings(measurements, structure=STRUCTURE, forgetting_time=forgetting_time)
    )
    estimates = run(identifier, messages(measurements))
    at_rest = next(e for e in estimates if e.t_ns - estimates[0].t_ns > 33e9)
    return identifier, flight, at_rest, estimates[-1]


RESTING = ("pdot/dr", "rdot/dr", "pdot/dth")


def test_without_forgetting_what_rests_is_kept() -> None:
    identifier, _, at_rest, last = at_rest_and_last(0.0)
    for name in RESTING:
        place = identifier.structure.index(name)
        assert abs(last.coefficients[place] - at_rest.coefficients[place]) < at_rest.sigma[place]
        assert last.sigma[place] < 2.0 * at_rest.sigma[place]


def test_what_rests_is_forgotten_with_its_row_and_sigma_says_so() -> None:
    """For four forgetting times; what goes on moving stays as well known."""
    identifier, flight, at_rest, last = at_rest_and_last(10.0)
    for name in RESTING:
        place = identifier.structure.index(name)
        assert last.sigma[place] > 0.9 * at_rest.sigma[place]
        assert abs(last.coefficients[place] - flight.coefficients_at(0.0)[place]) < (
            2.0 * last.sigma[place]
        )
    assert not last.usable_rows[2]
    assert worst(errors(last.coefficients, STRUCTURE, flight, ("pdot/da", "qdot/de"))) < 0.05
