# SPDX-License-Identifier: Apache-2.0
"""The prior, against the derivatives of real aircraft."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from uav_ident_ros.identification import prior
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.regression import RowSamples, layout
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES

FLIGHT = STRUCTURES["flight_dynamics"]


def sigma(name: str) -> float:
    """Return the weak prior's sigma in the largest structure with this coefficient."""
    own = next(one for one in reversed(STRUCTURES.values()) if name in one.names)
    return float(prior.weak_sigma(own)[own.index(name)])


LIFT, SIDE = sigma("az/alpha"), sigma("ay/beta")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # multiples of the largest derivatives of ultra_stick_25e, a model of 1.3 m
        ("pdot/p", 2 * 16.1),
        ("qdot/alpha", 3 * 102.5),
        ("pdot/da", 6 * 159.0),
        # lift equals weight, with C_La 5 and C_L 0.5; the side force is a sixth of it
        ("az/alpha", GRAVITY * 5.0 / 0.5),
        ("ay/beta", LIFT / 6.0),
        # a rudder makes most of the side force, an elevator little of the lift
        ("ay/dr", 0.9 * 2.0 / 3.0 * SIDE),
        ("az/de", 1.6 * 0.5 * 0.2 * LIFT),
        # a yaw rate changes the sideslip of the fin by its arm, 1.5 m, over 15 m/s
        ("ay/p", 1.5 / 15.0 * SIDE),
        ("ay/r", 1.5 / 15.0 * SIDE),
        # errors of the kinematics: accelerometer bias, and incidence of the wing
        ("betadot/1", 0.1 * GRAVITY / 5.0),
        ("alphadot/1", 0.1 * GRAVITY / 5.0),
        ("betadot/p", np.deg2rad(12.0)),
        # that of a measured force follows from the lift slope
        ("qdot/az", sigma("qdot/de") / 98.0),
    ],
)
def test_the_weak_prior_covers_the_derivatives_of_real_aircraft(name: str, expected: float) -> None:
    assert sigma(name) == pytest.approx(expected, rel=0.2)


def test_force_slopes_start_at_lift_equals_weight_and_are_bounded() -> None:
    slopes, bounds = prior.first_values(FLIGHT), prior.slope_bounds(FLIGHT)
    lift, side = FLIGHT.index("az/alpha"), FLIGHT.index("ay/beta")
    assert (slopes[lift], slopes[side]) == (-LIFT, -SIDE)
    assert bounds[lift] == pytest.approx(-GRAVITY * 4.0 / 1.6, rel=0.2)
    assert bounds[side] == pytest.approx(0.1 * slopes[side])


def test_well_known_coefficients_are_resumed_with_a_sigma_of_a_fifth() -> None:
    values = prior.first_values(FLIGHT)
    saved = CoefficientSet(FLIGHT.name, values, np.where(FLIGHT.mask, 1e-9, 0.0))
    known = values != 0.0
    assert prior.resumed(saved).sigma[known] == pytest.approx(0.2 * np.abs(values[known]), rel=1e-6)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_damping_is_bounded_by_zero_unless_a_measured_force_has_a_share(structure: str) -> None:
    own = STRUCTURES[structure]
    damping = tuple(zip(*map(own.index, ("pdot/p", "qdot/q", "rdot/r")), strict=True))
    for free in (own.mask, own.mask & ~own.mask):
        shared = structure == "augmented" and free.any()
        expected = np.inf if shared else 0.0
        np.testing.assert_array_equal(prior.physical_bounds(own, free)[damping], expected)


def added(structure: str, name: str, value: float, **more: Any) -> tuple[Information, prior.Start]:
    """Information of samples with a given coefficient, with the regressors as instruments."""
    own = STRUCTURES[structure]
    problem, start = layout(own), prior.start_from(Settings(structure=structure))
    start = replace(start, free=start.free & more.pop("free", own.mask))
    rng = np.random.default_rng(1)
    regressors = rng.normal(size=(problem.rows, 400, problem.width))
    regressors[..., 1:] += 0.3 * regressors[..., :1]  # correlated, but not collinear
    regressors *= problem.used[:, None]
    truth = np.where(problem.used, rng.uniform(-9.0, -1.0, problem.used.shape), 0.0)
    truth[(problem.place == own.index(name)).all(axis=2) & problem.used] = value
    y = (regressors @ truth[..., None])[..., 0] + rng.normal(size=(problem.rows, 400))
    signals = np.concatenate((0.0 * y[..., None], y[..., None], regressors, regressors), axis=2)
    information = Information(own, start, correlation_time=0.1, **more)
    information.add([RowSamples(signals, 0.01)], np.ones(problem.rows))
    return information, start


def test_a_coefficient_beyond_its_bound_is_solved_as_fixed_at_the_bound() -> None:
    own = STRUCTURES["throttle_coupled"]
    fixed = own.mask.copy()
    fixed[own.index("pdot/p")] = False
    bounded, given = (
        information.solve(start.values).values[0]
        for information, start in (
            added(own.name, "pdot/p", 3.0),
            added(own.name, "pdot/p", 3.0, free=fixed),
        )
    )
    assert bounded[own.index("pdot/p")] == pytest.approx(0.0, abs=1e-12)
    assert bounded[own.index("qdot/q")] < -0.5
    np.testing.assert_allclose(bounded, given, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("name", "held"), [("pdot/p", False), ("az/alpha", True)])
def test_while_instruments_warm_up_only_the_force_slopes_are_bounded(name: str, held: bool) -> None:
    information, start = added("flight_dynamics", name, 3.0, instrumental=(True,))
    assert information.warming_up.all()
    solution, at = information.solve(start.values), FLIGHT.index(name)
    largest = prior.physical_bounds(FLIGHT, start.free)[at]
    assert solution.values[0][at] == (pytest.approx(largest) if held else pytest.approx(3.0, abs=1))
    assert solution.unbounded[0][at] > largest
