# SPDX-License-Identifier: Apache-2.0
"""Allocation: the least-squares solution within the limits, and axes that lost their input."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from uav_ident_ros.control.allocation import allocate, authority, bounded_least_squares

# roll, pitch, yaw by de, dr, da, dth of a light aircraft; the throttle is not used
EFFECT = np.array([[0.0, 3.2, 31.0, 0.0], [-27.0, 0.0, 0.0, 0.0], [0.0, -4.3, -0.2, 0.1]])
LIMITS = np.array([[-0.5, -0.28, -0.35, 0.0], [0.4, 0.28, 0.26, 0.0]])
SCALE = authority(EFFECT, LIMITS)


@pytest.mark.parametrize("seed", range(200))
def test_the_active_set_method_equals_scipys_solution(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m = int(rng.integers(2, 6))
    rows = np.vstack([rng.normal(size=(3, m)), 1e-3 * np.eye(m)])
    if seed % 3 == 0:
        rows[:3, 0] = 0.0  # a dead input
    target = np.append(rng.normal(size=3) * rng.choice([0.1, 1.0, 10.0]), np.zeros(m))
    low, high = -rng.uniform(0.0, 1.0, m), rng.uniform(0.0, 1.0, m)
    if seed % 4 == 0:
        low[-1] = high[-1] = 0.0  # an input that is not in use
    found = bounded_least_squares(rows, target, low, high)
    free, expected = low < high, np.zeros(m)
    bounds = (low[free], high[free])
    expected[free] = lsq_linear(rows[:, free], target, bounds, method="bvls", tol=1e-14).x
    assert (found >= low).all() and (found <= high).all()
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_a_saturated_input_does_not_affect_the_other_axes() -> None:
    wanted = np.array([20.0, -1.0, 0.3])  # twice the aileron's authority
    u = allocate(EFFECT, wanted, LIMITS, SCALE)
    got = EFFECT @ u
    assert u[2] == LIMITS[1, 2]
    assert got[1] == pytest.approx(-1.0, rel=0.01)
    assert got[2] == pytest.approx(0.3, abs=0.01)


def test_without_known_derivatives_no_input_moves() -> None:
    assert not allocate(np.zeros((3, 4)), np.ones(3), LIMITS, SCALE).any()


@pytest.mark.parametrize("where", ["effect", "wanted"])
def test_values_that_are_not_finite_are_refused(where: str) -> None:
    effect, wanted = EFFECT.copy(), np.zeros(3)
    (effect[0] if where == "effect" else wanted)[0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        allocate(effect, wanted, LIMITS, np.ones(3))


def test_two_axes_at_their_limits_keep_their_own_inputs() -> None:
    """At low speed, banked and nose-up, neither axis uses the other's surface."""
    effect = np.array([[0.0, 0.4, 1.8, 0.0], [-3.6, 0.0, 0.0, 0.0], [0.0, -0.4, 0.03, 0.0]])
    limits = np.array([[-0.35, -0.35, -0.35, 0.0], [0.35, 0.35, 0.35, 0.0]])
    healthy = np.array([1.4, 1.0, 0.35])
    u = allocate(effect, np.array([2.2, -2.0, -0.5]), limits, healthy)
    assert u[:2] == pytest.approx([0.35, 0.35])
    assert (effect @ u)[0] > 0.4


def test_an_axis_without_an_input_does_not_affect_the_others() -> None:
    effect = EFFECT.copy()
    effect[:, 2] = 0.0
    got = effect @ allocate(effect, np.array([9.0, -1.0, 0.3]), LIMITS, SCALE)
    assert got[1:] == pytest.approx([-1.0, 0.3], rel=1e-3)
