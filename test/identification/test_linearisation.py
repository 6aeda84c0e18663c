# SPDX-License-Identifier: Apache-2.0
"""The linear model and its modes, against an aircraft of known derivatives."""

import math
from typing import Any

import numpy as np
import pytest
from equations import matrix
from light_aircraft import SPEED, TRUTH

from uav_ident_ros.identification import linearisation
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray

FLIGHT = STRUCTURES["flight_dynamics"]
LEVEL = linearisation.Condition(SPEED)


def aircraft(**changes: float) -> FloatArray:
    """Coefficients of the light aircraft with changes, named as ``qdot_alpha``."""
    named = {name.replace("_", "/"): value for name, value in changes.items()}
    return matrix(FLIGHT, TRUTH | named)


def found(values: FloatArray, share: float = 0.0) -> dict[str, linearisation.Mode]:
    sigma = share * np.abs(values)
    return {mode.name: mode for mode in linearisation.level_modes(FLIGHT, values, sigma, SPEED)}


def test_the_modes_are_the_eigenvalues_of_the_equations_written_out() -> None:
    c = TRUTH
    longitudinal = np.array([[c["qdot/q"], c["qdot/alpha"]], [1.0, c["az/alpha"] / SPEED]])
    lateral = np.array([
        [c["pdot/p"], c["pdot/r"], c["pdot/beta"], 0.0],
        [c["rdot/p"], c["rdot/r"], c["rdot/beta"], 0.0],
        [-GRAVITY / c["az/alpha"], -1.0, c["ay/beta"] / SPEED, GRAVITY / SPEED],
        [1.0, 0.0, 0.0, 0.0],
    ])  # fmt: skip
    own = found(aircraft())
    assert list(own) == ["short period", "roll", "dutch roll", "spiral"]
    (period,) = (v for v in np.linalg.eigvals(longitudinal) if v.imag > 0.0)
    eigenvalues = np.linalg.eigvals(lateral)
    (dutch,) = (v for v in eigenvalues if v.imag > 1e-9)
    roll, spiral = sorted(v.real for v in eigenvalues if abs(v.imag) <= 1e-9)
    for name, value in (("short period", period), ("dutch roll", dutch)):
        assert own[name].eigenvalue == pytest.approx(complex(value))
        assert own[name].frequency == pytest.approx(abs(value))
        assert own[name].damping == pytest.approx(-value.real / abs(value))
        assert math.isnan(own[name].time_constant)
    for name, value in (("roll", roll), ("spiral", spiral)):
        assert own[name].eigenvalue.real == pytest.approx(value)
        assert own[name].time_constant == pytest.approx(-1.0 / value)
        assert math.isnan(own[name].frequency)


@pytest.mark.parametrize(
    ("changes", "name", "others"),
    [
        ({"qdot_alpha": 5.0}, "longitudinal", ["roll", "dutch roll", "spiral"]),
        # roll and spiral couple into a lateral phugoid
        ({"pdot_p": -0.5, "pdot_r": 0.0}, "lateral", ["short period"]),
    ],
)
def test_modes_without_pitch_stiffness_or_roll_damping_have_other_names(
    changes: dict[str, float], name: str, others: list[str]
) -> None:
    own = linearisation.modes(FLIGHT, aircraft(**changes), np.zeros(FLIGHT.mask.shape), LEVEL)
    two = [mode.eigenvalue.real for mode in own if mode.name == name]
    assert len(two) == 2 and two == sorted(two)
    assert [mode.name for mode in own if mode.name != name] == others


def test_the_standard_deviations_are_those_of_a_monte_carlo() -> None:
    share, rng, values = 0.02, np.random.default_rng(1), aircraft()
    own = found(values, share)
    draws: dict[str, list[Any]] = {name: [] for name in own}
    for _ in range(600):
        for name, mode in found(values * (1.0 + share * rng.normal(size=values.shape))).items():
            value = mode.eigenvalue
            mean = (value.real, value.imag, mode.frequency, mode.damping, mode.time_constant)
            draws[name].append(mean)
    for name, mode in own.items():
        assert len(draws[name]) == 600
        spread = np.std(draws[name], axis=0)
        given = (
            *mode.eigenvalue_sigma, mode.frequency_sigma, mode.damping_sigma,
            mode.time_constant_sigma,
        )  # fmt: skip
        np.testing.assert_allclose(given, spread, rtol=0.1, atol=1e-12)


def test_the_linearisation_in_a_turn_includes_the_rate_products() -> None:
    values = aircraft(pdot_qr=-0.7, qdot_pr=0.85, rdot_pq=-0.25)
    rates = (0.1, 0.3, -0.2)
    a, _ = linearisation.linearise(FLIGHT, values, linearisation.Condition(SPEED, rates))
    still, _ = linearisation.linearise(FLIGHT, values, LEVEL)
    p, q, r = rates
    expected = [[0.0, -0.7 * r, -0.7 * q], [0.85 * r, 0.0, 0.85 * p], [-0.25 * q, -0.25 * p, 0.0]]
    np.testing.assert_allclose((a - still)[:3, :3], expected, atol=1e-12)


@pytest.mark.parametrize("name", ["baseline", "augmented"])
def test_without_flow_angles_there_are_three_states_and_no_modes(name: str) -> None:
    structure = STRUCTURES[name]
    values = matrix(structure, {"pdot/p": -4.0, "pdot/da": 20.0})
    a, b = linearisation.linearise(structure, values, LEVEL)
    assert a.shape == (3, 3)
    assert (a[0, 0], b[0, 2]) == (-4.0, 20.0)
    assert linearisation.level_modes(structure, values, np.zeros_like(values), SPEED) == []
