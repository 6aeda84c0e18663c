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
from uav_ident_ros.import_logs.knowledge import table


def describe_rotation(number: int) -> str:
    """Say what a number of the list means."""
    angles = table("rotations").get(number)
    if angles is None:
        return f"rotation {number}"
    named = zip(("roll", "pitch", "yaw"), angles, strict=True)
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
    listed = table("rotations").get(number)
    if listed is None:
        return None
    coarse, fine = (
        rotation(*(math.radians(angle) for angle in angles)) for angles in (listed, offsets)
    )
    return np.asarray(fine @ coarse)
