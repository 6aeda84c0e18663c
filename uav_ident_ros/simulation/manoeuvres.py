# SPDX-License-Identifier: Apache-2.0
"""Rates to follow, as in normal flight: banks and pitch changes at random times.

Nothing is added to excite anything.
"""

import math

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import FloatArray

ANGLE_GAIN = 1.0
"""Rate of an angle per rad of its error, 1/s."""

SMOOTHING = 0.2
"""Time constant of these rates, s: a pilot's hand, not a step."""

MAX_RATES = (0.35, 0.15)
"""Largest rates of bank and pitch angle, rad/s: 20 and 9 deg/s."""

STEADY_TIME = 2.0
"""Time of straight flight at the start, s."""

LEAST_BANK = 0.4
"""Smallest bank as a fraction of the largest."""


class Manoeuvres:
    """Bank and pitch angles to fly, and the rates that lead there."""

    def __init__(
        self,
        bank: float,  # bank, pitch: Largest bank angle, and largest change of the pitch angle, rad
        pitch: float,
        hold: tuple[float, float],  # Shortest and longest time between changes, s
        airspeed: float,  # For coordinated turns, m/s
        seed: int,  # Seed of the angles and times
    ) -> None:
        self._bank, self._pitch, self._hold, self._airspeed = bank, pitch, hold, airspeed
        self._rng = np.random.default_rng(seed)
        self._target = [0.0, 0.0]  # bank, pitch beyond the first
        self._next = [STEADY_TIME, STEADY_TIME]
        self._side = 1.0
        self._level: float | None = None
        self._rates: FloatArray = np.zeros(2)

    def rates(
        self,
        time: float,  # After the first call, s
        roll: float,  # roll, pitch: Attitude, rad, FRD
        pitch: float,
        dt: float,  # Time since the last call, s
    ) -> FloatArray:
        """Return p, q, r to follow, rad/s, FRD."""
        if self._level is None:
            self._level = pitch
        self._choose(time)
        error = np.array([self._target[0] - roll, self._level + self._target[1] - pitch])
        wanted = np.clip(ANGLE_GAIN * error, np.negative(MAX_RATES), MAX_RATES)
        self._rates = self._rates + min(1.0, dt / SMOOTHING) * (wanted - self._rates)
        return body_rates(self._rates, roll, pitch, GRAVITY / self._airspeed * math.tan(roll))

    def _choose(self, time: float) -> None:
        for i in range(2):
            if time >= self._next[i]:
                self._next[i] = time + self._rng.uniform(*self._hold)
                if i == 0:
                    size = self._bank * self._rng.uniform(LEAST_BANK, 1.0)
                    self._target[0], self._side = self._side * size, -self._side
                else:
                    self._target[1] = self._pitch * self._rng.uniform(-1.0, 1.0)


def body_rates(angle_rates: FloatArray, roll: float, pitch: float, turn: float) -> FloatArray:
    """Body rates p, q, r from those of bank, pitch (angle_rates) and heading (turn), rad/s."""
    bank_rate, pitch_rate = angle_rates
    return np.array(
        [
            bank_rate - turn * math.sin(pitch),
            pitch_rate * math.cos(roll) + turn * math.cos(pitch) * math.sin(roll),
            -pitch_rate * math.sin(roll) + turn * math.cos(pitch) * math.cos(roll),
        ]
    )
