# SPDX-License-Identifier: Apache-2.0
"""The change detector with ticks of any length, as after a stall or a flood."""

from __future__ import annotations

import numpy as np
import pytest

from uav_ident_ros.identification.estimators.change import ChangeDetector
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import STRUCTURES

STRUCTURE = STRUCTURES["augmented"]


@pytest.mark.parametrize(
    "lengths", [(6.0, 6.0, 6.0), (4.9, 0.05, 0.05, 0.3), (2.0, 2.0, 0.9, 0.001), (0.05,) * 150]
)
def test_no_sequence_of_tick_lengths_is_too_odd(lengths: tuple[float, ...]) -> None:
    chance = np.random.default_rng(1)
    detector = ChangeDetector(STRUCTURE.mask)
    for length in lengths:
        f = chance.normal(size=(10, STRUCTURE.size))
        data = Regression(y=chance.normal(size=(10, 3)), f=f, z=f, dt=length / 10)
        changed = detector.update(
            data, np.zeros((3, STRUCTURE.size)), np.ones(4, dtype=bool), np.ones(3, dtype=bool)
        )
        assert changed == []
        assert np.isfinite(detector.found.slope).all()


def test_a_window_does_not_reach_over_a_gap() -> None:
    chance = np.random.default_rng(1)
    detector = ChangeDetector(STRUCTURE.mask)
    everything = (np.zeros((3, STRUCTURE.size)), np.ones(4, dtype=bool), np.ones(3, dtype=bool))
    for k in range(130):
        f = chance.normal(size=(10, STRUCTURE.size))
        data = Regression(chance.normal(size=(10, 3)), f, f, 0.005, restarted=k == 120)
        detector.update(data, *everything)
    assert len(detector.recent) == 10


@pytest.mark.parametrize(("noise", "noticed"), [(0.05, True), (0.5, False)])
def test_what_does_not_stand_out_must_explain_the_residual(noise: float, noticed: bool) -> None:
    """A lost surface does; what an autopilot answers to a storm explains little of it."""
    chance = np.random.default_rng(2)
    detector = ChangeDetector(STRUCTURE.mask)
    coefficients = np.zeros((3, STRUCTURE.size))
    coefficients[1, 8] = -20.0
    found = []
    for k in range(1400):  # ticks of 0.05 s
        f = np.zeros((10, STRUCTURE.size))
        f[:, 8] = 0.03 * np.sin(0.1 * k) + 0.01 * chance.normal()
        lost = 12.0 if k >= 1200 else 0.0
        y = f @ coefficients.T + noise * chance.normal(size=3)
        y[:, 1] += lost * f[:, 8]
        data = Regression(y, f, f, 0.005)
        changed = detector.update(
            data, coefficients, np.ones(4, dtype=bool), np.zeros(3, dtype=bool)
        )
        found += [(k, *change) for change in changed]
    assert [(i, j) for _, i, j in found[:1]] == ([(1, 0)] if noticed else [])
    assert all(1200 < k < 1320 for k, _, _ in found[:1])
