# SPDX-License-Identifier: Apache-2.0
"""A flight of a plant whose coefficients follow the airspeed exactly."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.inputs import Segment, sample_inputs
from uav_ident_ros.simulation.vehicles import vehicle

RATE = 200.0
REFERENCE = 20.0
START_NS = 1_700_000_000 * 10**9
PLANT = vehicle("small_uav")
STRUCTURE = STRUCTURES[PLANT.structure]


def airspeed(t: FloatArray) -> FloatArray:
    """Slow swings between 14 and 28 m/s."""
    return 21.0 + 7.0 * np.sin(2 * np.pi * t / 40.0)


def scaled(speed: float) -> FloatArray:
    """Coefficients of the plant at an airspeed."""
    ratio = speed / REFERENCE
    power = np.r_[np.zeros(5), np.ones(3), 2.0 * np.ones(4)]
    return PLANT.coefficients * ratio**power


def flight(duration: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, rates and inputs of a plant whose coefficients follow the airspeed."""
    t = np.arange(round(duration * RATE)) / RATE
    amplitudes = {"de": 0.08, "dr": 0.12, "da": 0.06, "dth": 0.2}
    u = sample_inputs([Segment("multisine", amplitudes=amplitudes, seed=1)], t)
    speed = airspeed(t)
    x = np.zeros((len(t), 3))
    h = 1.0 / RATE
    for k in range(len(t) - 1):
        a = scaled(float(speed[k]))

        def xdot(state: FloatArray, a: FloatArray = a, k: int = k) -> FloatArray:
            return a @ STRUCTURE.regressor(state, u[k])

        k1 = xdot(x[k])
        k2 = xdot(x[k] + 0.5 * h * k1)
        k3 = xdot(x[k] + 0.5 * h * k2)
        k4 = xdot(x[k] + h * k3)
        x[k + 1] = x[k] + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
    return t, x, u


def worst_linear(found: FloatArray, truth: FloatArray) -> float:
    linear = STRUCTURE.mask & (np.arange(12) >= 5)
    return float(np.abs(found / np.where(linear, truth, 1.0) - 1.0)[linear].max())
