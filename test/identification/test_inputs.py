# SPDX-License-Identifier: Apache-2.0
"""Channels to inputs, cell means and the servo lag, against closed forms."""

import numpy as np
import pytest

from uav_ident_ros.identification.sampling import InputMap, ServoLag, cell_means
from uav_ident_ros.identification.settings import Settings

MS = 1_000_000


def reference_mean(
    t: np.ndarray, u: np.ndarray, left: float, right: float, interpolation: str
) -> float:
    """Mean by brute force on a fine midpoint grid."""
    at = left + (np.arange(20_000) + 0.5) * (right - left) / 20_000
    if interpolation == "linear":
        return float(np.interp(at, t, u).mean())
    return float(u[np.searchsorted(t, at, side="right") - 1].mean())


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_cell_means_of_irregular_samples(interpolation: str) -> None:
    rng = np.random.default_rng(1)
    t_ns = np.sort(rng.choice(np.arange(200), 40, replace=False)).astype(np.int64) * MS
    u = rng.normal(size=(40, 4))
    first, last = int(t_ns[0]), int(t_ns[-1])
    edges = np.arange(first, last, 7 * MS, dtype=np.int64)
    means = cell_means(t_ns, u, edges, interpolation)
    for i in range(len(edges) - 1):
        for c in range(4):
            expected = reference_mean(
                t_ns / MS, u[:, c], edges[i] / MS, edges[i + 1] / MS, interpolation
            )
            assert means[i, c] == pytest.approx(expected, abs=2e-3)


def test_servo_lag_is_exact_for_inputs_held_over_the_cells() -> None:
    tau, h = 0.08, 0.005
    u = np.repeat(np.random.default_rng(2).normal(size=(12, 4)), 6, axis=0)
    lag = ServoLag(tau, h)
    lag.apply(np.zeros((1, 4)), restarted=True)
    means = np.concatenate([lag.apply(part, restarted=False) for part in (u[:31], u[31:])])
    state = np.zeros(4)
    for k, command in enumerate(u):
        # mean of command + (state - command) exp(-t / tau) over the cell
        share = tau / h * -np.expm1(-h / tau)
        np.testing.assert_allclose(means[k], command + (state - command) * share, atol=1e-13)
        state = command + (state - command) * np.exp(-h / tau)


def test_a_motors_thrust_follows_its_curve() -> None:
    """PX4's model: thrust = f s^2 + (1 - f) s of the scaled command."""
    values = {
        "actuators.scale": [0.001, 1.0, 1.0, 1.0],
        "actuators.trim": [500.0, 0.5, 0.5, 0.5],
        "actuators.thrust_curve": [1.0, 0.3, 0.0, 1.0],
    }
    mapping = InputMap(Settings.from_values(values).actuators)
    u = mapping.apply(np.array([600.0, 0.6, 0.6, 0.5]))
    mixed = 0.3 * (0.36 - 0.25) + 0.7 * 0.1
    np.testing.assert_allclose(u, [0.36 - 0.25, mixed, 0.1, 0.0], atol=1e-12)
    # over a cell it is the thrust that is averaged, not the command
    t = np.arange(4, dtype=np.int64) * 10_000_000
    raw = np.array([[400.0, 0.4, 0.4, 0.4], [600.0, 0.6, 0.6, 0.6]] * 2)
    edges = np.array([0, 40_000_000], dtype=np.int64)
    mean = mapping.mix(cell_means(t, mapping.curved(raw), edges, "hold"))
    np.testing.assert_allclose(mean[0], mapping.apply(raw).mean(axis=0), atol=1e-12)
