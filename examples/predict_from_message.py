# SPDX-License-Identifier: Apache-2.0
"""Predict the next second from one message of ~/coefficients_named, without this package.

The equations are those of docs/controllers.md, "The model behind the numbers", in plain Python.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, cos, sin
from typing import Any

GRAVITY = 9.80665  # m/s^2
STEP = 0.01  # longest step, s
REGRESSORS = ("pq", "qr", "pr", "pp", "rr", "p", "q", "r", "de", "dr", "da", "dth", "1")


def predict(message: Any, rates: Sequence[float], u: Sequence[float], dt: float) -> list[float]:
    """Return p, q, r, beta, alpha `dt` s after the message, from the present p, q, r, at fixed `u`.

    `message` is a sensor_msgs/msg/JointState of structure flight_dynamics; rates in rad/s, FRD;
    `u` are de, dr, da, dth, deviations from trim.
    """
    a: dict[str, float] = dict(zip(message.name, message.position, strict=True))
    roll, pitch, speed = a["state/roll"], a["state/pitch"], a["state/airspeed"]
    down = [-sin(pitch), sin(roll) * cos(pitch), cos(roll) * cos(pitch)]

    def slope(state: list[float]) -> list[float]:
        p, q, r, beta, alpha, dx, dy, dz = state
        values = (p * q, q * r, p * r, p * p, r * r, p, q, r, *u, 1.0, beta, alpha)
        f = dict(zip((*REGRESSORS, "beta", "alpha"), values, strict=True))

        def row(name: str) -> float:
            return sum(a.get(f"{name}/{label}", 0.0) * value for label, value in f.items())

        return [
            row("pdot"),
            row("qdot"),
            row("rdot"),
            p * alpha - r + (row("ay") + GRAVITY * dy) / speed + row("betadot"),
            q - p * beta + (row("az") + GRAVITY * dz) / speed + row("alphadot"),
            dy * r - dz * q,
            dz * p - dx * r,
            dx * q - dy * p,
        ]

    state = [*rates, a["state/beta"], a["state/alpha"], *down]
    steps = max(1, ceil(dt / STEP))
    h = dt / steps
    for _ in range(steps):  # Runge-Kutta of order 4
        k1 = slope(state)
        k2 = slope([s + 0.5 * h * k for s, k in zip(state, k1, strict=True)])
        k3 = slope([s + 0.5 * h * k for s, k in zip(state, k2, strict=True)])
        k4 = slope([s + h * k for s, k in zip(state, k3, strict=True)])
        sums = zip(state, k1, k2, k3, k4, strict=True)
        state = [s + h / 6.0 * (w + 2.0 * (x + y) + z) for s, w, x, y, z in sums]
    return state[:5]
