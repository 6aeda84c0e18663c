# SPDX-License-Identifier: Apache-2.0
"""The equations of motion with flow angles as books write them, and slopes by differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import FloatArray


def flight_equations(a: FloatArray, state: FloatArray, u: FloatArray, v: float) -> FloatArray:
    """Rates of change of p, q, r, beta, alpha, roll, pitch at airspeed `v`, m/s."""
    p, q, r, beta, alpha, roll, pitch = state
    rows = a @ np.array([p * q, q * r, p * r, p * p, r * r, p, q, r, *u, 1.0, beta, alpha])
    side, down = (GRAVITY * part(roll) * np.cos(pitch) for part in (np.sin, np.cos))
    return np.array([
        *rows[:3],
        -r + (rows[3] + side) / v + rows[5],
        q + (rows[4] + down) / v + rows[6],
        p + np.tan(pitch) * (q * np.sin(roll) + r * np.cos(roll)),
        q * np.cos(roll) - r * np.sin(roll),
    ])  # fmt: skip


def slope(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Derivative by central differences, a column for each argument."""
    steps = 1e-6 * np.eye(len(at))
    return np.stack([(function(at + h) - function(at - h)) / 2e-6 for h in steps], axis=1)
