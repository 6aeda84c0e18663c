# SPDX-License-Identifier: Apache-2.0
"""The excitation gate: the weight of a row's samples, and its signal-to-noise ratio."""

import numpy as np
import pytest

from uav_ident_ros.identification.gates import ExcitationGate
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
    """Return qdot's weight at each tick; elevator amplitude in rad, disturbance in rad/s^2."""
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
    """A gate after half a minute of excitation."""
    gate = ExcitationGate(FREE, SupervisionSettings())
    assert set(flown(gate, 30.0, 0.05)[1:]) == {1.0}
    return gate


def test_a_rows_weight_falls_in_quiet_flight_and_returns_after_it(gate: ExcitationGate) -> None:
    weights = flown(gate, 10.0, 0.005)
    assert weights[5] == 1.0  # the window still contains the excitation
    assert 0.0 < max(weights[31:]) < 0.02  # 3 s later the window is quiet
    assert not gate.learning[1]
    assert flown(gate, 2.0, 0.05)[-1] == 1.0


def test_a_slow_multisine_counts_as_excitation() -> None:
    gate = ExcitationGate(FREE, SupervisionSettings())
    flown(gate, 30.0, 0.05, hz=0.15)
    assert min(flown(gate, 30.0, 0.05, hz=0.15)) > 0.5


def test_the_signal_is_not_clear_after_a_second_in_a_gust_front(gate: ExcitationGate) -> None:
    assert gate.clear[1]  # variances 0.5 and 0.01 (rad/s^2)^2
    assert gate.signal[1] == pytest.approx(0.5 * (0.05 * EFFECT) ** 2 / 0.1**2, rel=0.3)
    flown(gate, 1.25, 0.05, disturbance=1.2)
    assert gate.learning[1] and not gate.clear[1]
    flown(gate, 2.0, 0.05, disturbance=0.85)
    assert gate.clear[1]
