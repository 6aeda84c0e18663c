# SPDX-License-Identifier: Apache-2.0
"""The bound of benchmarks/excitation_bound.py: what is drawn from it, and that it is one."""

from __future__ import annotations

import excitation_bound
import numpy as np
import pytest
from excitation_bound import DOMINANT, TICK, covariances, drawn, fly, for_good

from uav_ident_ros.simulation.light_aircraft import TRUTH


def test_errors_are_drawn_with_the_covariance_of_their_time_and_shrink_towards_the_end() -> None:
    size = len(DOMINANT)
    variances = np.array([4.0, 2.0, 2.0, 0.5])
    errors = drawn(variances[:, None, None] * np.eye(size), 0)
    np.testing.assert_allclose(errors.var(axis=(0, 2)), variances, rtol=0.2)
    # What is learned in between is independent of what is left: none where nothing is learned.
    np.testing.assert_allclose(errors[:, 1], errors[:, 2], atol=1e-12)
    assert np.mean(errors[:, 0] * errors[:, 3]) == pytest.approx(0.5, rel=0.3)


def test_for_good_is_from_the_last_time_on_that_it_was_not() -> None:
    near = np.ones((10, len(DOMINANT)), dtype=bool)
    near[3, 0] = near[6, -1] = near[9, 1] = False
    found, tick = for_good(near), TICK / excitation_bound.RATE
    assert found[DOMINANT[0]] == pytest.approx(4 * tick)
    assert found[DOMINANT[-1]] == pytest.approx(7 * tick)
    assert found[DOMINANT[1]] == found["all"] == np.inf


def test_the_bound_falls_with_the_excitation_and_rises_with_the_gusts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(excitation_bound, "START", 2.0)
    monkeypatch.setattr(excitation_bound, "DURATION", 12.0)
    aileron = DOMINANT.index("pdot/da")

    def sigma(gusts: str, excited: bool) -> float:
        flight, _ = fly(gusts, 1, excited)
        last = covariances(flight, excitation_bound.GUSTS[gusts])[-1]
        assert (np.linalg.eigvalsh(last) > 0.0).all()
        return float(np.sqrt(last[aileron, aileron]) / TRUTH["pdot/da"])

    excited, heavy, quiet = sigma("light", True), sigma("heavy", True), sigma("light", False)
    assert 0.0 < excited < heavy < 1.0
    assert excited < 0.5 * quiet
