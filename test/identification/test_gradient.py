# SPDX-License-Identifier: Apache-2.0
"""The paper's law against equation (8) integrated independently."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from uav_ident_ros.identification.estimators.gradient import gain_matrix, gradient_step
from uav_ident_ros.identification.settings import SettingsError
from uav_ident_ros.identification.structure import STRUCTURES

STRUCTURE = STRUCTURES["throttle_coupled"]
RNG = np.random.default_rng(4)
PHASES = RNG.uniform(0.0, 2 * np.pi, 7)
GAIN = np.diag(RNG.uniform(0.5, 2.0, 12))
DURATION = 4.0


def signals(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return smooth rates, their derivatives and inputs; the law needs no plant."""
    w = 1.0 + 0.4 * np.arange(7)
    s = np.sin(w * t + PHASES)
    return s[:3], (w * np.cos(w * t + PHASES))[:3], s[3:]


def equation_8(t: float, flat: np.ndarray) -> np.ndarray:
    """Right-hand side of (8) as printed, with both states and their difference."""
    xm, a = flat[:3], flat[3:].reshape(3, 12)
    x, xdot, u = signals(t)
    f, fm = STRUCTURE.regressor(x, u), STRUCTURE.regressor(xm, u)
    xm_dot = a @ fm
    e = (xdot - xm_dot) - a @ (f - fm)
    return np.concatenate([xm_dot, (np.outer(e, f) @ GAIN * STRUCTURE.mask).ravel()])


def integrate_law(steps: int, guarded: bool) -> np.ndarray:
    dt = DURATION / steps
    a = np.zeros((3, 12))
    for k in range(steps):
        x, xdot, u = signals(k * dt)
        a, _ = gradient_step(
            a, xdot, STRUCTURE.regressor(x, u), GAIN, STRUCTURE.mask, dt, guarded=guarded
        )
    return a


@pytest.mark.parametrize("guarded", [True, False])
def test_the_step_converges_to_equation_8_with_first_order(guarded: bool) -> None:
    start = np.concatenate([signals(0.0)[0], np.zeros(36)])
    exact = solve_ivp(equation_8, (0.0, DURATION), start, rtol=1e-11, atol=1e-12, method="DOP853")
    reference = exact.y[3:, -1].reshape(3, 12)
    errors = [np.abs(integrate_law(n, guarded) - reference).max() for n in (400, 800, 1600, 3200)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.1)
    assert errors[-1] < 5e-3


def test_the_guarded_step_never_overshoots() -> None:
    rng = np.random.default_rng(6)
    for _ in range(200):
        root = rng.normal(size=(12, 12))
        gain = root @ root.T * 10.0 ** rng.uniform(-3, 9)
        a = np.where(STRUCTURE.mask, rng.normal(size=(3, 12)), 0.0)
        f, y = rng.normal(size=12) * 10.0 ** rng.uniform(-2, 2), rng.normal(size=3)
        before = y - a @ f
        moved, _ = gradient_step(a, y, f, gain, STRUCTURE.mask, 0.05, guarded=True)
        after = y - moved @ f
        assert np.isfinite(moved).all()
        assert (np.abs(after) <= np.abs(before) * (1 + 1e-9) + 1e-9).all()
        assert not moved[~STRUCTURE.mask].any()


def test_eulers_step_reports_its_size() -> None:
    f = np.zeros(12)
    f[5] = 2.0
    _, step = gradient_step(
        np.zeros((3, 12)), np.ones(3), f, 15.0 * np.eye(12), STRUCTURE.mask, 0.05, guarded=False
    )
    assert step == pytest.approx(0.05 * 15.0 * 4.0)


def test_gains_must_be_symmetric_and_positive_semi_definite() -> None:
    np.testing.assert_array_equal(gain_matrix((1.0, 2.0), 2), np.diag([1.0, 2.0]))
    np.testing.assert_array_equal(gain_matrix((2.0, 1.0, 1.0, 2.0), 2), [[2, 1], [1, 2]])
    with pytest.raises(SettingsError, match=r"not symmetric: K\[0,1\] = 1 but K\[1,0\] = 0"):
        gain_matrix((1.0, 1.0, 0.0, 1.0), 2)
    with pytest.raises(SettingsError, match="eigenvalue -1"):
        gain_matrix((1.0, 2.0, 2.0, 1.0), 2)
