# SPDX-License-Identifier: Apache-2.0
"""A surface that is late, or does less the more is asked of it, told from one that is not."""

from __future__ import annotations

import numpy as np
import pytest

from uav_ident_ros.identification.estimators.model_error import ModelError
from uav_ident_ros.identification.regression import Regression, layout
from uav_ident_ros.identification.row_samples import RowSamples
from uav_ident_ros.identification.structure import STRUCTURES

STRUCTURE = STRUCTURES["augmented"]
LAYOUT = layout(STRUCTURE)
DT, EVERYWHERE = 0.05, np.ones(3)
AILERON = 10
DAMPING, EFFECT = -6.0, 40.0


def rolled(
    travel: float = 1.0, noise: float = 0.3, lag: float = 0.0, seconds: float = 60.0, seed: int = 1
) -> RowSamples:
    """Samples of a roll by an aileron that travels so far, rad, of the 0.1 asked for, and lags."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(round(seconds / DT))
    u = 0.05 * (np.sin(1.3 * t) + np.sin(3.1 * t + 1.0))
    f, p = np.zeros((len(t), STRUCTURE.size)), 0.0
    y = np.zeros((len(t), 3))
    gusts, reached = noise * rng.normal(size=len(t)), 0.0
    for k, command in enumerate(u):
        keep = np.exp(-DT / lag) if lag else 0.0
        reached = keep * reached + (1.0 - keep) * np.clip(command, -travel, travel)
        y[k, 0] = DAMPING * p + EFFECT * reached + gusts[k]
        f[k, [5, AILERON]] = p, command
        p += DT * y[k, 0]
    return RowSamples.of(Regression(y, f, f, DT), y).pick(LAYOUT)


def share(samples: RowSamples) -> np.ndarray:
    """What is found, with two samples at a time."""
    looked = ModelError(LAYOUT)
    for k in range(0, samples.y.shape[1], 2):
        part = slice(k, k + 2)
        looked.add(
            RowSamples(
                samples.y[:, part], samples.residual[:, part], samples.f[:, part],
                samples.z[:, part], samples.dt,
            ),
            EVERYWHERE,
            restarted=k == 0,
        )  # fmt: skip
    return looked.share


@pytest.mark.parametrize("travel", [0.015, 0.03, 0.05])
def test_an_aileron_that_saturates_is_found(travel: float) -> None:
    """In roll alone: elevator and rudder do not move."""
    found = share(rolled(travel))
    assert found[0] > 0.1
    assert found[1:].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("lag", [0.08, 0.12])
def test_an_aileron_that_lags_is_found(lag: float) -> None:
    assert share(rolled(lag=lag))[0] > 0.1


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_aileron_that_does_as_it_is_told_is_not(noise: float, seed: int) -> None:
    assert share(rolled(noise=noise, seed=seed))[0] < 0.01


def test_a_row_that_is_learned_anew_is_forgotten() -> None:
    looked = ModelError(LAYOUT)
    for seed in range(40):
        looked.add(rolled(0.02, seconds=2.0, seed=seed), EVERYWHERE, restarted=True)
    assert looked.share[0] > 0.1
    looked.forget(0)
    assert looked.share[0] == 0.0
    for seed in range(20):
        looked.add(rolled(seconds=2.0, seed=seed), EVERYWHERE, restarted=True)
    assert looked.share[0] == 0.0
