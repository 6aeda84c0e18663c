# SPDX-License-Identifier: Apache-2.0
"""How a flight controller sits in the aircraft: the numbers that PX4 and ArduPilot share.

``SENS_BOARD_ROT`` and ``AHRS_ORIENTATION`` count the same list (MAVLink's
MAV_SENSOR_ORIENTATION): roll, pitch and yaw of the board, applied in this order.
"""

from __future__ import annotations

import math

import numpy as np

from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.knowledge import table
from uav_ident_ros.import_logs.stamps import interpolate


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
    coarse, fine = (
        rotation(*(math.radians(angle) for angle in angles)) for angles in (listed, offsets)
    )
    return np.asarray(fine @ coarse)


def quaternions(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Return the unit quaternions x, y, z, w of Euler angles (rad), shape (n, 4)."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (np.cos(angle / 2.0), np.sin(angle / 2.0)) for angle in (roll, pitch, yaw)
    )
    return np.column_stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def at_times(t_ns: TimeArray, samples_ns: TimeArray, quaternion: FloatArray) -> FloatArray:
    """Return unit quaternions (k, 4) at other times (n,), joined along the shorter arcs."""
    flips = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    joined = interpolate(t_ns, samples_ns, quaternion * np.append(1.0, flips)[:, None])
    return np.asarray(joined / np.linalg.norm(joined, axis=1, keepdims=True))
