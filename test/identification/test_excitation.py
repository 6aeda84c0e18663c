# SPDX-License-Identifier: Apache-2.0
"""The excitation gate: how much a row may learn, and where its inputs stand out."""

import numpy as np
import pytest

from uav_ident_ros.identification.estimators.excitation import ExcitationGate
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import STRUCTURES

STRUCTURE = STRUCTURES["augmented"]
DT, ELEVATOR, EFFECT = 0.05, 8, -20.0
FREE = np.zeros_like(STRUCTURE.mask)
FREE[1, ELEVATOR] = True


def flown(
    gate: ExcitationGate,
    seconds: float,
    amplitude: float,
    disturbance: float = 0.1,
    hz: float = 1.0,
) -> list[float]:
    """Let the elevator move, rad, in disturbances, rad/s^2; return qdot's weight, tick by tick."""
    chance, weights = np.random.default_rng(1), []
    coefficients = np.zeros(STRUCTURE.mask.shape)
    coefficients[1, ELEVATOR] = EFFECT
    for k in range(round(seconds / (2 * DT))):
        t = DT * (2 * k + np.arange(2))
        f = np.zeros((2, STRUCTURE.size))
        f[:, ELEVATOR] = amplitude * np.sin(2.0 * np.pi * hz * t)
        residual = disturbance * chance.normal(size=(2, 3))
        weights.append(
            float(gate.update(Regression.of(residual, f, f, DT), residual, coefficients)[1])
        )
    return weights


@pytest.fixture
def gate() -> ExcitationGate:
    """A gate that has seen half a minute of excitation."""
    gate = ExcitationGate(FREE, SupervisionSettings())
    assert set(flown(gate, 30.0, 0.05)[1:]) == {1.0}
    return gate


def test_a_row_learns_little_in_quiet_flight_and_at_once_when_it_is_over(
    gate: ExcitationGate,
) -> None:
    weights = flown(gate, 10.0, 0.005)
    assert weights[5] == 1.0  # the window still holds what was
    assert 0.0 < max(weights[31:]) < 0.02  # 3 s later it does not
    assert not gate.learning[1]
    assert flown(gate, 2.0, 0.05)[-1] == 1.0


def test_a_slow_multisine_still_moves_in_the_window() -> None:
    gate = ExcitationGate(FREE, SupervisionSettings())
    flown(gate, 30.0, 0.05, hz=0.15)
    assert min(flown(gate, 30.0, 0.05, hz=0.15)) > 0.5


def test_inputs_stand_out_until_a_gust_front_is_a_second_old(gate: ExcitationGate) -> None:
    assert gate.clear[1]  # 0.5 rms of the surface against 0.01 of the residual
    assert gate.signal[1] == pytest.approx(0.5 * (0.05 * EFFECT) ** 2 / 0.1**2, rel=0.3)
    flown(gate, 1.25, 0.05, disturbance=1.2)
    assert gate.learning[1] and not gate.clear[1]
    flown(gate, 2.0, 0.05, disturbance=0.85)
    assert gate.clear[1]
