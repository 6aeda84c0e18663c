# SPDX-License-Identifier: Apache-2.0
"""The noise model: it finds the autoregression that is there, and whitens with it."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.noise import MEMORY, ORDER, NoiseModel, Whitener

DT = 0.05
WEIGHTS = np.array([[1.2, -0.5, 0.1], [0.0, 0.0, 0.0], [-0.4, 0.2, 0.3]])
SPREAD = np.array([0.1, 2.0, 1e-3])


def residuals(ticks: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of three rows with known autoregressions, and the innovations in them."""
    rng = np.random.default_rng(seed)
    white = SPREAD * rng.normal(size=(ticks, 3))
    out = np.zeros((ticks + ORDER, 3))
    for k in range(ticks):
        past = out[k : k + ORDER][::-1]
        out[k + ORDER] = (WEIGHTS.T * past).sum(axis=0) + white[k]
    return out[ORDER:], white


def correlation(signals: np.ndarray, lag: int) -> np.ndarray:
    return (signals[lag:] * signals[:-lag]).mean(axis=0) / (signals**2).mean(axis=0)


def test_the_autoregression_of_each_row_is_found() -> None:
    """Averaged over several stretches of the memory: each is an estimate from that much."""
    model, found = NoiseModel(3), []
    for k, residual in enumerate(residuals(12_000)[0]):
        model.add(residual, DT)
        if k and k % round(MEMORY / DT) == 0:
            found.append((model.weights.copy(), model.variance.copy()))
    weights, variance = (np.mean(part, axis=0) for part in zip(*found, strict=True))
    np.testing.assert_allclose(weights, WEIGHTS, atol=0.08)
    np.testing.assert_allclose(variance, SPREAD**2, rtol=0.15)


def test_what_is_left_after_whitening_is_white() -> None:
    model, whitener, out = NoiseModel(3), Whitener((3,)), []
    coloured = residuals(6_000)[0]
    for residual in coloured:
        model.add(residual, DT)
        out.append(whitener.apply(residual, model))
    assert all(part is None for part in out[:ORDER])
    white = np.array(out[1000:])
    for lag in (1, 2, 3, 5):
        assert np.abs(correlation(white, lag)).max() < 0.1
    assert correlation(coloured, 1)[0] > 0.7


def test_with_the_true_weights_the_innovations_come_back() -> None:
    """Each signal of a row goes through the model of that row, whatever their number."""
    coloured, white = residuals(200)
    model, whitener = NoiseModel(3), Whitener((3, 2))
    model.weights = WEIGHTS
    for k, residual in enumerate(coloured):
        out = whitener.apply(np.stack([residual, -3.0 * residual], axis=1), model)
        if k < ORDER:
            assert out is None
        else:
            assert out is not None
            np.testing.assert_allclose(out[:, 0], white[k], atol=1e-12)
            np.testing.assert_allclose(out[:, 1], -3.0 * white[k], atol=1e-12)


def test_a_new_stretch_does_not_continue_the_old_one() -> None:
    model, whitener = NoiseModel(3), Whitener((3,))
    for residual in residuals(100)[0]:
        model.add(residual, DT)
        whitener.apply(residual, model)
    weights = model.weights.copy()
    model.restart()
    whitener.restart()
    np.testing.assert_array_equal(model.weights, weights)  # what was learned stays
    for k in range(ORDER):
        assert whitener.apply(np.ones(3), model) is None, k
    assert whitener.apply(np.ones(3), model) is not None


def test_nothing_and_next_to_nothing_are_no_trouble() -> None:
    for value in (0.0, 1e-300, 1e150):
        model = NoiseModel(2)
        for k in range(100):
            model.add(np.array([value, 0.0]) * (-1.0) ** k, DT)
        assert np.isfinite(model.weights).all()
        assert np.isfinite(model.variance).all()
        assert (model.variance >= 0.0).all()
