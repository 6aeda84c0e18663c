# SPDX-License-Identifier: Apache-2.0
"""Lift and side force oppose the flow: signs of pitch and yaw rate, without turns."""

from functools import cache

import numpy as np
import pytest
from flying import TICK, by_ticks, light_measured

from uav_ident_ros.identification.lift import LiftSigns
from uav_ident_ros.identification.scales import DOUBTLESS, SURE
from uav_ident_ros.identification.structure import FloatArray

BLOCK, SPEED = 40, 20.0
DOWN = 9.80665 * np.array([0.0, 0.0, 1.0])


@cache
def level(excited: bool) -> tuple[FloatArray, FloatArray]:
    """Rates and specific forces of a minute's level flight, excited or in gusts alone."""
    flight = {} if excited else {"segments": (), "gust": 2.0}
    return by_ticks(light_measured(60.0, sensors={"convention": "frd"}, **flight))


def sigmas(rates: FloatArray, force: FloatArray) -> FloatArray:
    """Return the evidence of fy and fz after all samples."""
    signs = LiftSigns()
    for first in range(0, len(rates), BLOCK):
        omega, f = (signal[first : first + BLOCK] for signal in (rates, force))
        signs.add(np.full(len(f), TICK), omega, f, np.tile(DOWN, (len(f), 1)), SPEED)
    return signs.sigmas


@pytest.mark.parametrize("excited", [True, False], ids=["excited", "in gusts alone"])
@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1)], ids=str)
def test_a_wrong_sign_of_a_rate_turns_its_force(signs: tuple[int, int], excited: bool) -> None:
    q, r = signs
    rates, force = level(excited)
    side, lift = sigmas(rates * [1, q, r], force)
    assert -r * side > SURE
    assert -q * lift > SURE


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_shows_no_sign(seed: int) -> None:
    """On the ground, with a gyro bias and an attitude that is off by ten degrees."""
    rng = np.random.default_rng(seed)
    rates = 0.05 + rng.normal(0.0, 0.01, (4000, 3))
    force = rng.normal(0.0, 0.2, (4000, 3)) - DOWN + [0.0, 1.7, 0.1]
    assert np.abs(sigmas(rates, force)).max() < DOUBTLESS


def test_one_gust_is_no_evidence() -> None:
    """However strong, one block is one sigma at most."""
    rates, force = level(True)
    assert np.abs(sigmas(rates[:20], 1e3 * force[:20])).max() < 1.0 + 1e-9
