# SPDX-License-Identifier: Apache-2.0
"""What a motor or a surface contributes to de, dr, da, dth.

Signs as everywhere in the project: positive de pitches down, dr yaws left, da rolls right. The
autopilots count pitch up and yaw right as positive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import Effect

ROTATION_RANGE = 2.0
"""Sum of the weights' absolute values in de, dr, da of a multirotor: one is then half of the
motors at full and half at nothing. As in config/px4_quadrotor.yaml."""


def from_torques(roll: float, pitch: float, yaw: float, thrust: float = 0.0) -> Effect:
    """Effect of an actuator with these shares in rolling right, pitching up, yawing right."""
    return (_positive_zero(-pitch), _positive_zero(-yaw), _positive_zero(roll), thrust)


def _positive_zero(value: float) -> float:
    return value + 0.0


def rotor_effects(
    positions: FloatArray,  # (N, 2) Forward and right of the centre, in any unit
    # Yawing moment per thrust: positive for a rotor that turns counter-clockwise from above, whose
    # reaction yaws the vehicle right
    moment_ratios: Sequence[float],
    thrusts: Sequence[float],  # Relative thrust at full command
) -> list[Effect]:
    """Effects of the upward rotors of a multirotor, each row of the mixing in a fixed range."""
    thrust = np.asarray(thrusts, dtype=float)
    forward, right = positions.T
    rows = np.array([forward, moment_ratios, -right]) * thrust  # pitch up, yaw right, roll right
    rows[np.abs(rows) < 1e-9 * max(np.abs(rows).max(), 1e-9)] = 0.0
    size = np.abs(rows).sum(axis=1, keepdims=True)
    rows = ROTATION_RANGE * np.divide(rows, size, out=np.zeros_like(rows), where=size > 0.0)
    collective = thrust / thrust.sum()
    return [
        from_torques(float(roll), float(pitch), float(yaw), float(share))
        for pitch, yaw, roll, share in zip(*rows, collective, strict=True)
    ]


def on_a_circle(angles: Sequence[float]) -> FloatArray:
    """Positions (N, 2), forward and right, of arms at angles clockwise from the nose, deg."""
    return np.array([[math.cos(math.radians(a)), math.sin(math.radians(a))] for a in angles])
