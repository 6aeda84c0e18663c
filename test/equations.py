# SPDX-License-Identifier: Apache-2.0
"""Reference aircraft: its coefficients, textbook equations of motion, numerical derivatives."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.integrate import solve_ivp

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import FloatArray, Structure

# A light aircraft: damping 6, 5 and 0.5 1/s; aileron, elevator, rudder; forces; flow angles.
AIRCRAFT = {
    "pdot/p": -6.4, "pdot/r": 0.7, "pdot/da": 29.5, "pdot/dr": -3.1, "pdot/pq": 0.2,
    "pdot/qr": -0.4, "pdot/ay": 1.1, "qdot/q": -5.5, "qdot/de": -26.0, "qdot/pr": 0.8,
    "qdot/az": 0.2, "qdot/1": 1.8, "rdot/p": -0.4, "rdot/r": -0.5, "rdot/dr": -2.4,
    "rdot/da": -0.2, "rdot/pq": -0.1, "rdot/ay": -0.35,
    "pdot/beta": -14.0, "qdot/alpha": -30.0, "rdot/beta": 5.0, "ay/beta": -12.0, "ay/dr": 4.0,
    "ay/p": -0.2, "ay/r": 0.5, "az/alpha": -90.0, "az/de": -6.0,
    "betadot/p": 0.05, "betadot/1": 0.02, "alphadot/1": -0.01,
}  # fmt: skip


def matrix(structure: Structure, entries: Mapping[str, float]) -> FloatArray:
    """Return a structure's coefficient matrix; missing values are zero, foreign names ignored."""
    out = np.zeros(structure.mask.shape)
    for name, value in entries.items():
        if name in structure.names:
            out[structure.index(name)] = value
    return out


def flight_equations(a: FloatArray, state: FloatArray, u: FloatArray, v: float) -> FloatArray:
    """Return the derivatives of p, q, r, beta, alpha, roll, pitch at airspeed `v`, m/s."""
    p, q, r, beta, alpha, roll, pitch = state
    rows = a @ np.array([p * q, q * r, p * r, p * p, r * r, p, q, r, *u, 1.0, beta, alpha])
    side, down = (GRAVITY * part(roll) * np.cos(pitch) for part in (np.sin, np.cos))
    return np.array([
        *rows[:3],
        p * alpha - r + (rows[3] + side) / v + rows[5],
        q - p * beta + (rows[4] + down) / v + rows[6],
        p + np.tan(pitch) * (q * np.sin(roll) + r * np.cos(roll)),
        q * np.cos(roll) - r * np.sin(roll),
    ])  # fmt: skip


def flown(a: FloatArray, state: FloatArray, u: FloatArray, v: float, seconds: float) -> FloatArray:
    """Integrate the equations with constant inputs; return the final state."""
    return solve_ivp(
        lambda _, x: flight_equations(a, x, u, v), (0.0, seconds), state, rtol=1e-10, atol=1e-12
    ).y[:, -1]


def with_down(state: FloatArray) -> FloatArray:
    """Return the model's own state, (..., 8), with the direction of down for roll and pitch."""
    *first, roll, pitch = np.moveaxis(state, -1, 0)
    level = np.cos(pitch)
    down = (-np.sin(pitch), np.sin(roll) * level, np.cos(roll) * level)
    return np.stack([*first, *down], axis=-1)


def slope(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Return the derivative by central differences, one column per argument."""
    steps = 1e-6 * np.eye(len(at))
    return np.stack([(function(at + h) - function(at - h)) / 2e-6 for h in steps], axis=1)
