# SPDX-License-Identifier: Apache-2.0
"""How a flight controller sits in the aircraft: the numbers that PX4 and ArduPilot share.

``SENS_BOARD_ROT`` and ``AHRS_ORIENTATION`` count the same list (MAVLink's
MAV_SENSOR_ORIENTATION): roll, pitch and yaw of the board, applied in this order.
"""

from __future__ import annotations

import math

import numpy as np

from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.structure import FloatArray

BOARD_ROTATIONS: tuple[tuple[float, float, float], ...] = (
    (0, 0, 0),
    (0, 0, 45),
    (0, 0, 90),
    (0, 0, 135),
    (0, 0, 180),
    (0, 0, 225),
    (0, 0, 270),
    (0, 0, 315),
    (180, 0, 0),
    (180, 0, 45),
    (180, 0, 90),
    (180, 0, 135),
    (0, 180, 0),
    (180, 0, 225),
    (180, 0, 270),
    (180, 0, 315),
    (90, 0, 0),
    (90, 0, 45),
    (90, 0, 90),
    (90, 0, 135),
    (270, 0, 0),
    (270, 0, 45),
    (270, 0, 90),
    (270, 0, 135),
    (0, 90, 0),
    (0, 270, 0),
    (0, 180, 90),
    (0, 180, 270),
    (90, 90, 0),
    (180, 90, 0),
    (270, 90, 0),
    (90, 180, 0),
    (270, 180, 0),
    (90, 270, 0),
    (180, 270, 0),
    (270, 270, 0),
    (90, 180, 90),
    (90, 0, 270),
    (90, 68, 293),
    (0, 315, 0),
    (90, 315, 0),
)
"""Roll, pitch, yaw of the numbers 0 to 40, deg. Beyond them the two autopilots differ."""


def describe_rotation(number: int) -> str:
    """Say what a number of the list means."""
    if not 0 <= number < len(BOARD_ROTATIONS):
        return f"rotation {number}"
    named = zip(("roll", "pitch", "yaw"), BOARD_ROTATIONS[number], strict=True)
    return " ".join(f"{axis} {angle:g} deg" for axis, angle in named if angle) or "none"


def board_to_body(number: int, offsets: tuple[float, float, float]) -> FloatArray | None:
    """Rotation matrix from the board's axes to the body's, shape (3, 3).

    Parameters
    ----------
    number : int
        Number of the list.
    offsets : tuple of 3 floats
        Fine roll, pitch, yaw applied after it, deg.

    Returns
    -------
    (3, 3) array or None
        None if the number is not on the list.
    """
    if not 0 <= number < len(BOARD_ROTATIONS):
        return None
    coarse, fine = (
        rotation(*(math.radians(angle) for angle in angles))
        for angles in (BOARD_ROTATIONS[number], offsets)
    )
    return np.asarray(fine @ coarse)
