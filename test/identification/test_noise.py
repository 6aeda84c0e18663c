# SPDX-License-Identifier: Apache-2.0
"""The noise model: the autoregression of the residuals, and whitening with it."""

import numpy as np
import pytest
from scipy.signal import lfilter

from uav_ident_ros.identification.regression import RowSamples
from uav_ident_ros.identification.residuals import Autoregression
from uav_ident_ros.identification.scales import MEMORY

DT = 0.05
WEIGHTS = np.array([[1.2, -0.5, 0.1], [0.0, 0.0, 0.0], [-0.4, 0.2, 0.3]])
SPREAD = np.array([0.1, 2.0, 1e-3])


def residuals(ticks: int) -> np.ndarray:
    """Residuals of three rows with known autoregressions."""
    white = SPREAD * np.random.default_rng(1).normal(size=(ticks, 3))
    pairs = zip(WEIGHTS, white.T, strict=True)
    return np.stack([lfilter([1.0], [1.0, *-weights], own) for weights, own in pairs], axis=1)


def whiten(model: Autoregression, residual: np.ndarray, restarted: bool = False) -> RowSamples:
    """Whiten residuals (m, rows), with regressors that are their multiples."""
    f = residual[:, :1] * [1.0, -3.0]
    rows = [np.column_stack((e, 2.0 * e, f, f)) for e in residual.T]
    return RowSamples(model.whiten(np.array(rows), DT, restarted=restarted), DT)


def test_the_autoregression_of_each_row_is_estimated() -> None:
    """Averaged over several memories: each estimate uses one."""
    model, found = Autoregression(3), []
    for part in np.split(residuals(12_000), 12_000 * DT / MEMORY):
        for pair in np.split(part, len(part) // 2):
            whiten(model, pair)
        found.append((model.weights.copy(), model.variance.copy()))
    weights, variance = (np.mean(part, axis=0) for part in zip(*found, strict=True))
    np.testing.assert_allclose(weights, WEIGHTS, atol=0.08)
    np.testing.assert_allclose(variance, SPREAD**2, rtol=0.15)


def test_a_new_stretch_is_whitened_without_the_old_one() -> None:
    model = Autoregression(3)
    whiten(model, residuals(100))
    weights = model.weights.copy()
    assert not whiten(model, np.ones((2, 3)), restarted=True).signals.any()
    np.testing.assert_array_equal(model.weights, weights)  # the autoregression stays
    white = whiten(model, np.ones((2, 3)))
    assert not white.signals[:, 0].any()
    assert white.signals[:, 1].all()


def test_the_noise_model_is_fitted_every_0_3_s() -> None:
    model, residual = Autoregression(3), residuals(400)
    fits = 0
    for part in np.split(residual, 200):
        before = model.weights
        whiten(model, part)
        fits += model.weights is not before
    # the first two samples after LOOK_TIME
    assert fits == pytest.approx(len(residual) * DT / 0.3, abs=1)


def test_the_innovation_of_a_predictable_signal_is_a_hundredth_of_it() -> None:
    """The past predicts a slow sine fully."""
    sine = np.sin(0.5 * DT * np.arange(2000))[:, None] * SPREAD
    model = Autoregression(3)
    for part in np.split(sine, 1000):
        whiten(model, part)
    np.testing.assert_allclose(model.variance, 0.01 * np.mean(sine**2, axis=0), rtol=0.1)
