# SPDX-License-Identifier: Apache-2.0
"""What autopilots' parameters mean: the YAML tables of this folder, mixers, board rotations.

Signs as everywhere in the project: positive de pitches down, dr yaws left, da rolls right. The
autopilots count pitch up and yaw right as positive. ``SENS_BOARD_ROT`` and ``AHRS_ORIENTATION`` are
numbers of one list (MAVLink, MAV_SENSOR_ORIENTATION): roll, pitch, yaw of the board, in order.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import yaml

from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import Effect, ImportLogError
from uav_ident_ros.import_logs.stamps import interpolate

SENSES = {"ccw": 1.0, "cw": -1.0}
"""Yawing moment per thrust, right positive, by the rotor's sense of rotation from above."""

ROTATION_RANGE = 2.0
"""Sum of the weights' absolute values in de, dr, da of a multirotor: one is then half of the
motors at full and half at nothing. As in config/px4_quadrotor.yaml."""


@cache
def table(name: str) -> dict[Any, Any]:
    """Return the table of this name."""
    file = resources.files(__package__).joinpath(f"{name}.yaml")
    return dict(yaml.safe_load(file.read_text(encoding="utf-8")))


def effect_of(entry: Mapping[str, Any], share: float = 1.0) -> Effect:
    """Return the effect of what rolls right, pitches up, yaws right and pushes by some shares."""
    roll, pitch, yaw, thrust = (
        float(entry.get(axis, 0.0)) * share for axis in ("roll", "pitch", "yaw", "thrust")
    )
    return (0.0 - pitch, 0.0 - yaw, roll + 0.0, thrust)  # never -0.0


def effects_of_arms(arms: Sequence[str]) -> list[Effect]:
    """Return the effects of equal rotors, each given as its arm's angle and sense of rotation.

    The angle is clockwise from the nose, deg.
    """
    angles, senses = zip(*(arm.split() for arm in arms), strict=True)
    bearings = np.radians(np.array(angles, dtype=float))
    positions = np.column_stack([np.cos(bearings), np.sin(bearings)])
    return rotor_effects(positions, [SENSES[sense] for sense in senses], [1.0] * len(arms))


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
    rows = np.array([-right, forward, moment_ratios]) * thrust
    rows[np.abs(rows) < 1e-9 * max(np.abs(rows).max(), 1e-9)] = 0.0
    size = np.abs(rows).sum(axis=1, keepdims=True)
    rows = ROTATION_RANGE * np.divide(rows, size, out=np.zeros_like(rows), where=size > 0.0)
    names = ("roll", "pitch", "yaw", "thrust")
    columns = np.vstack([rows, thrust / thrust.sum()]).T.tolist()
    return [effect_of(dict(zip(names, column, strict=True))) for column in columns]


def between(
    low: float,  # low, high: raw values at the ends of the range
    high: float,
    sign: float = 1.0,  # -1 if the range is turned round
    centre: float | None = None,  # Raw value at rest of what deflects to both sides
) -> tuple[float, float]:
    """Return scale and neutral of a channel that runs from nothing to full, or to both sides.

    Raises
    ------
    ImportLogError
        If that is no range.
    """
    if not high > low:
        raise ImportLogError(f"an output is said to run from {low:g} to {high:g}: no range")
    if centre is None:
        return sign / (high - low), low if sign > 0.0 else high
    return 2.0 * sign / (high - low), centre


def describe_rotation(number: int) -> str:
    """Say what a number of the list means."""
    angles = table("rotations").get(number)
    if angles is None:
        return f"rotation {number}"
    named = zip(("roll", "pitch", "yaw"), angles, strict=True)
    return " ".join(f"{axis} {angle:g} deg" for axis, angle in named if angle) or "none"


def board_to_body(
    number: int,  # Number of the list
    offsets: tuple[float, float, float],  # Fine roll, pitch, yaw applied after it, deg
) -> FloatArray | None:
    """Rotation matrix from the board's axes to the body's, shape (3, 3).

    Returns
    -------
    (3, 3) array or None
        None if the number is not on the list.
    """
    listed = table("rotations").get(number)
    if listed is None:
        return None
    return np.asarray(rotation(*np.radians(offsets)) @ rotation(*np.radians(listed)))


def quaternions(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Return the unit quaternions x, y, z, w of Euler angles (rad), shape (n, 4)."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (np.cos(angle / 2.0), np.sin(angle / 2.0)) for angle in (roll, pitch, yaw)
    )
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return np.column_stack([x, y, z, w])


def at_times(t_ns: TimeArray, samples_ns: TimeArray, quaternion: FloatArray) -> FloatArray:
    """Return unit quaternions (k, 4) at other times (n,), joined along the shorter arcs."""
    flips = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    joined = interpolate(t_ns, samples_ns, quaternion * np.append(1.0, flips)[:, None])
    return np.asarray(joined / np.linalg.norm(joined, axis=1, keepdims=True))
