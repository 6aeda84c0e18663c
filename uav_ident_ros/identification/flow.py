# SPDX-License-Identifier: Apache-2.0
"""Observer of attitude, sideslip and angle of attack from rates and specific forces alone.

Attitude: a complementary filter on the direction of gravity, ``gdot = -(omega + k m x g) x g``
with ``m`` the direction of the centripetal acceleration ``V x omega`` less the specific force
(Mahony, Hamel and Pflimlin 2008), and omega less a significant bias of the gyro. The filter that
finds it gives the attitude from then on, block by block. Flow angles: their kinematics with the
measured rates and forces, corrected towards the angle at which the force rows give the measured
force.
"""

from __future__ import annotations

from math import asin, atan2, cos, exp, inf, sin
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.gyro import GyroFilters
from uav_ident_ros.identification.model import GRAVITY, LARGEST_ANGLE, plan_steps
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.scales import GRAVITY_BAND, RESPONSE_TIME
from uav_ident_ros.identification.speed import LARGEST_SPEED_RATIO
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    RATE_COLUMNS,
    FloatArray,
    Structure,
)

ATTITUDE_GAIN = 0.1
"""Gain of the correction by the accelerometer, 1/s. A sideslip that changes looks like a turn of
gravity: at 3 rad/s it enters the flow angle with 3 %, and yaw damping with as much. In the time
constant of 10 s an unknown bias of the gyro turns the attitude by a few degrees, until it is known.
"""

_ROLL, _BIAS = RATE_COLUMNS.start, CONSTANT_COLUMN

Vector = tuple[float, float, float]
Force = tuple[list[tuple[int, float]], float]
"""A force row: entries of a sample with their coefficients, and the slope by the flow angle."""

Steps = tuple[FloatArray, FloatArray, FloatArray, bool, bool]
"""Steps of a block: durations, s, rates, rad/s, and specific forces, m/s^2; whether they show the
axes, and whether the forces have a correction for a lever arm."""


class FlowState(NamedTuple):
    """Attitude, flow angles and airspeed at a tick: the model's state beside the rates.

    Parameters
    ----------
    beta, alpha : float
        Sideslip and angle of attack, rad; zero where ay and az are zero.
    beta_sigma, alpha_sigma : float
        Their standard deviations, rad, by those of the slopes of the forces.
    roll, pitch : float
        Attitude, rad.
    airspeed : float
        True airspeed, m/s; the reference if none is measured.
    """

    beta: float
    alpha: float
    beta_sigma: float
    alpha_sigma: float
    roll: float
    pitch: float
    airspeed: float

    @property
    def down(self) -> Vector:
        """Unit vector that points down, body axes FRD."""
        level = cos(self.pitch)
        return -sin(self.pitch), sin(self.roll) * level, cos(self.roll) * level


class FlowObserver:
    """Observer of attitude and flow angles, block by block."""

    def __init__(
        self,
        structure: Structure,  # One with flow angles
        # Bandwidth of the correction of the flow angles by the forces, rad/s: the regression's
        cutoff: float,
        # Airspeed if none is measured, or if it is too low, m/s: it is a divisor
        reference: float,
    ) -> None:
        self._rate = cutoff
        self._reference = reference
        self._rows = structure.flow
        # At the newest edge: sideslip and angle of attack, rad, and the unit vector that points
        # down, body axes FRD
        self.angles = [0.0, 0.0]
        self.down: Vector = (0.0, 0.0, 1.0)
        self._bias: Vector = (0.0, 0.0, 0.0)
        self._speed = reference
        self.gyro = GyroFilters()
        # Whether the attitude was replaced after the last block: it had drifted with a gyro bias
        self.realigned = False
        self._steps: list[Steps] = []  # Those that `gyro` has not seen
        self._steps_time = 0.0  # s

    @property
    def attitude(self) -> tuple[float, float]:
        """Roll and pitch at the newest edge, rad."""
        x, y, z = self.down
        return atan2(y, z), asin(min(max(-x, -1.0), 1.0))

    def state(self, coefficients: FloatArray, sigma: FloatArray) -> FlowState:
        """Return the state at the newest edge; coefficients and sigma have the shape (7, n)."""
        roll, pitch = self.attitude
        beta, alpha = self.angles
        shares = []
        for rows in self._rows:
            slope = abs(coefficients.item(rows.force, rows.angle))
            shares.append(sigma.item(rows.force, rows.angle) / slope if slope else inf)
        return FlowState(
            beta=beta,
            alpha=alpha,
            beta_sigma=abs(beta) * shares[0],
            alpha_sigma=abs(alpha) * shares[1],
            roll=roll,
            pitch=pitch,
            airspeed=self._speed,
        )

    def follow(
        self,
        block: Block,  # Measured signals over m cells
        coefficients: FloatArray,  # (7, n) A_m; its force rows convert forces to angles
        airspeed: float | None,  # True, m/s; None if none is measured
        *,
        shows_axes: bool = True,  # Whether the flight may show the axes of the Imu
    ) -> None:
        """Observe the attitude and flow angles over a block, and add them to it."""
        v = self._reference
        if airspeed is not None and airspeed > v / LARGEST_SPEED_RATIO:
            v = airspeed
        self._speed = v
        plan = plan_steps(len(block.u), block.h)
        rates, force = plan.means @ block.x, plan.means @ block.specific_force
        if block.by_turning is not None:
            force[:, 1:] -= plan.cell_means @ block.by_turning
        samples = np.concatenate((rates, plan.cell_means @ block.u, force), axis=1).tolist()
        if block.restarted:
            self._steps.clear()
            self._steps_time = 0.0
            self.gyro.restart()
        unbiased = (rates - self.gyro.bias).tolist()
        a = coefficients.tolist()
        missing = [(a[rows.kinematics][_ROLL], a[rows.kinematics][_BIAS]) for rows in self._rows]
        forces: list[Force] = [
            ([(j - _ROLL, a[rows.force][j]) for j in rows.others], a[rows.force][rows.angle])
            for rows in self._rows
        ]
        if block.restarted:
            self._restart(samples[0], unbiased[0], forces)
        edges = [(*self.angles, *self.down)]
        for dt, sample, turn in zip(plan.times, samples, unbiased, strict=True):
            self._turn(dt, turn, sample[-3:])
            self._move_angles(dt, sample, forces, missing)
            edges.append((*self.angles, *self.down))
        block.state = np.concatenate((block.x, plan.lines @ np.array(edges)), axis=1)
        block.airspeed = v
        block.restarted = block.restarted or self.realigned
        corrected = block.by_turning is not None
        self._find_bias((np.array(plan.times), rates, force, shows_axes, corrected))

    def _turn(self, dt: float, rates: list[float], force: list[float]) -> None:
        """Turn the down vector over a step, and correct it towards that of the specific force."""
        (mx, my, mz), weight = _gravity(force, rates, self._speed)
        (p, q, r), (gx, gy, gz), (bx, by, bz) = rates, self.down, self._bias
        gain = ATTITUDE_GAIN * weight
        ex, ey, ez = my * gz - mz * gy, mz * gx - mx * gz, mx * gy - my * gx  # m x g
        # Critically damped
        integral = 0.0 if self.gyro.found else 0.25 * ATTITUDE_GAIN * gain * dt
        bx, by, bz = self._bias = (bx - integral * ex, by - integral * ey, bz - integral * ez)
        wx, wy, wz = p - bx + gain * ex, q - by + gain * ey, r - bz + gain * ez
        x = gx - dt * (wy * gz - wz * gy)
        y = gy - dt * (wz * gx - wx * gz)
        z = gz - dt * (wx * gy - wy * gx)
        size = (x * x + y * y + z * z) ** 0.5
        self.down = (x / size, y / size, z / size)

    def _move_angles(
        self,
        dt: float,
        sample: list[float],
        forces: list[Force],
        missing: list[tuple[float, float]],
    ) -> None:
        """Move the flow angles over a step: exact for signals that are constant over it.

        The constants of their kinematics contain the bias of the gyro.
        """
        p, q, r = sample[:3]
        measured = _measured_angles(sample, forces)
        (beta, alpha), keep = self.angles, exp(-self._rate * dt)
        for k, turning in ((0, p * alpha - r), (1, q - p * beta)):
            by_p, bias = missing[k]
            rate = turning + (sample[k - 2] + GRAVITY * self.down[1 + k]) / self._speed
            aim = measured[k] + (rate + by_p * p + bias) / self._rate
            self.angles[k] = aim + keep * (self.angles[k] - aim)

    def _find_bias(self, steps: Steps) -> None:
        """Pass the steps on when they have the length of a response, and use a bias found."""
        self.realigned = False
        times, _, force, _, _ = steps
        if not force.any():  # No accelerometer
            return
        self._steps.append(steps)
        self._steps_time += float(times.sum())
        if self._steps_time < RESPONSE_TIME:
            return
        *signals, shown, corrected = zip(*self._steps, strict=True)
        self._steps, self._steps_time, known = [], 0.0, self.gyro.found
        times, rates, force = map(np.concatenate, signals)
        flags = {"shows_axes": all(shown), "corrected": any(corrected)}
        self.gyro.add(times, rates, force, self._speed, **flags)
        self.realigned = self.gyro.found and not known
        if self.gyro.found:
            x, y, z = self.gyro.down.tolist()
            self.down, self._bias = (x, y, z), (0.0, 0.0, 0.0)

    def _restart(self, sample: list[float], rates: list[float], forces: list[Force]) -> None:
        """Initialise attitude and flow angles from the first sample."""
        direction, weight = _gravity(sample[-3:], rates, self._speed)
        if weight > 0.0:
            self.down = direction
        self.angles = _measured_angles(sample, forces)


def _measured_angles(sample: list[float], forces: list[Force]) -> list[float]:
    """Return the flow angles at which the force rows give the measured forces, rad."""
    measured = []
    for (others, slope), force in zip(forces, sample[-2:], strict=True):
        for k, coefficient in others:
            force -= coefficient * sample[k]
        angle = force / slope if slope else 0.0
        measured.append(min(max(angle, -LARGEST_ANGLE), LARGEST_ANGLE))
    return measured


def _gravity(force: list[float], rates: list[float], v: float) -> tuple[Vector, float]:
    """Return the direction of gravity by one sample, and its weight, 0 ... 1."""
    m = (-force[0], rates[2] * v - force[1], -rates[1] * v - force[2])
    size = (m[0] * m[0] + m[1] * m[1] + m[2] * m[2]) ** 0.5
    if size == 0.0:
        return (0.0, 0.0, 1.0), 0.0
    weight = max(0.0, 1.0 - abs(size - GRAVITY) / (GRAVITY_BAND * GRAVITY))
    return (m[0] / size, m[1] / size, m[2] / size), weight
