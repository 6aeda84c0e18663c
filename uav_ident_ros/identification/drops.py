# SPDX-License-Identifier: Apache-2.0
"""Which samples are dropped, and why: those that no working sensor can have sent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

LARGEST_GYRO_RATE = 100.0
"""Rate that no gyro of an aircraft measures, rad/s: 5700 deg/s."""

LARGEST_FORCE = 1000.0
"""Specific force that no aircraft survives, m/s^2: 100 g."""

LARGEST_CHANNEL = 1e5
"""Raw channel value of no known unit: radians, fractions, PWM microseconds and motor speeds
all stay below."""

LARGEST_AIRSPEED = 1000.0
"""Airspeed beyond any of these aircraft, m/s."""


LATEST_STAMP = (2**31 - 1) * 1_000_000_000
"""Last time that a ROS stamp can hold, ns: there is no message with the ticks after it."""


class Drop(StrEnum):
    """Why a sample was dropped."""

    NOT_FINITE = "not finite"
    WRONG_LENGTH = "wrong number of values"
    ZERO_STAMP = "zero or negative stamp"
    BEYOND_STAMP = "stamp beyond 2038"
    OUTLYING_STAMP = "outlying stamp"
    IMPLAUSIBLE = "implausibly large"
    GLITCH = "out of range for an instant"
    LATE = "late"
    DUPLICATE = "repeated stamp"
    CLOCK_MISMATCH = "stamp far from the Imu's"


def time_problem(t_ns: int) -> Drop | None:
    """Return why no sample can have this stamp, ns; None if one can."""
    if t_ns <= 0:
        return Drop.ZERO_STAMP
    return Drop.BEYOND_STAMP if t_ns > LATEST_STAMP else None


def value_problem(values: Sequence[float], count: int, largest: float) -> Drop | None:
    """Return why a sample's values cannot be used; None if they can.

    Parameters
    ----------
    values : sequence of floats
        The values, any unit.
    count : int
        How many there must be.
    largest : float
        Magnitude that none may exceed.
    """
    if len(values) != count:
        return Drop.WRONG_LENGTH
    if not math.isfinite(sum(values)):
        return Drop.NOT_FINITE
    if max(map(abs, values)) > largest:
        return Drop.IMPLAUSIBLE
    return None
