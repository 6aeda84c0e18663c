# SPDX-License-Identifier: Apache-2.0
"""Attitude, sideslip and angle of attack from the Imu alone: no vanes, no driver's orientation.

Attitude: a complementary filter on the direction of gravity, ``gdot = -(omega + k m x g) x g``
with ``m`` the direction of the centripetal acceleration ``V x omega`` less the specific force
(Mahony, Hamel and Pflimlin 2008). Flow angles: their kinematics with the measured rates and forces,
pulled to the angle at which the force rows give the measured force.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan2, cos, sin

import numpy as np

from uav_ident_ros.identification.model import (
    GRAVITY,
    LARGEST_ANGLE,
    FlowSignals,
    Steps,
    plan_steps,
)
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    RATE_COLUMNS,
    FloatArray,
    Structure,
)

ATTITUDE_GAIN = 0.3
"""Gain of the correction by the accelerometer, 1/s: the gyro drifts less than a degree in the
3 s that it leaves to it, and a turn's unmodelled acceleration seldom lasts so long."""

GRAVITY_BAND = 0.3
"""Difference of the corrected specific force from gravity, relative, at which it no longer tells
where down is; less difference, more weight."""

LEAST_SPEED_SHARE = 0.5
"""Airspeed relative to the reference below which the reference serves in its place: on the
ground and in hover nothing may be divided by an airspeed that goes to zero."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class FlowState:
    """Attitude, flow angles and airspeed at a tick: the rest of the model's state.

    Parameters
    ----------
    beta, alpha : float
        Sideslip and angle of attack, rad, from where ay and az vanish.
    beta_sigma, alpha_sigma : float
        Their standard deviations, rad: those of the slopes of the forces.
    roll, pitch : float
        Attitude, rad.
    airspeed : float
        True airspeed, m/s; the reference where none is measured.
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
    """Follows attitude and flow angles, block by block.

    Parameters
    ----------
    structure : Structure
        A structure with flow angles.
    cutoff : float
        Cut-off of the regression's low-pass, rad/s: the flow angles follow the force so fast, and
        no faster.
    reference : float
        Airspeed where none is measured, m/s.

    Attributes
    ----------
    angles : list of 2 floats
        Sideslip and angle of attack, rad, at the newest edge.
    down : tuple of 3 floats
        Unit vector that points down, body axes FRD, at the newest edge.
    """

    def __init__(self, structure: Structure, cutoff: float, reference: float) -> None:
        self._rate = cutoff
        self._reference = reference
        self._rows = structure.flow
        self.angles = [0.0, 0.0]
        self.down: Vector = (0.0, 0.0, 1.0)
        self._bias: Vector = (0.0, 0.0, 0.0)
        self._speed = reference

    @property
    def attitude(self) -> tuple[float, float]:
        """Roll and pitch at the newest edge, rad."""
        x, y, z = self.down
        return atan2(y, z), asin(min(max(-x, -1.0), 1.0))

    def state(self, coefficients: FloatArray, sigma: FloatArray) -> FlowState:
        """Return the state at the newest edge; with coefficients and sigma of shape (7, n)."""
        roll, pitch = self.attitude
        beta, alpha = self.angles
        beta_share, alpha_share = (
            abs(float(sigma[rows.force, rows.angle] / coefficients[rows.force, rows.angle]))
            for rows in self._rows
        )
        return FlowState(
            beta=beta,
            alpha=alpha,
            beta_sigma=abs(beta) * beta_share,
            alpha_sigma=abs(alpha) * alpha_share,
            roll=roll,
            pitch=pitch,
            airspeed=self._speed,
        )

    def follow(self, block: Block, coefficients: FloatArray, airspeed: float | None) -> FlowSignals:
        """Follow attitude and flow angles through a block.

        Parameters
        ----------
        block : Block
            Measured signals over m cells.
        coefficients : (7, n) array
            A_m; its force rows turn forces into angles.
        airspeed : float or None
            True airspeed, m/s; None where none is measured.
        """
        v = self._reference
        if airspeed is not None and airspeed > LEAST_SPEED_SHARE * self._reference:
            v = airspeed
        self._speed = v
        plan = plan_steps(len(block.u), block.h)
        dts = (plan.cells * block.h).tolist()
        rates = plan.means(0.5 * (block.x[:-1] + block.x[1:]))
        x = rates.tolist()
        force = plan.means(0.5 * (block.specific_force[:-1] + block.specific_force[1:]))
        told = self._told(force, np.hstack((rates, plan.means(block.u))), coefficients)
        directions = _gravity(force, x, v)
        if block.restarted:
            self._restart(directions, told)
        missing = [coefficients[5:7, j].tolist() for j in (RATE_COLUMNS.start, CONSTANT_COLUMN)]
        angles, downs = [tuple(self.angles)], [self.down]
        rows = zip(dts, x, force.tolist(), told.tolist(), directions, strict=True)
        for dt, rates, sample, angle, (m, weight) in rows:
            self._turn(dt, rates, m, ATTITUDE_GAIN * weight)
            self._follow_angles(dt, rates, sample, angle, v, missing)
            angles.append(tuple(self.angles))
            downs.append(self.down)
        return _signals(plan, angles, downs, v)

    def _told(self, force: FloatArray, rates_inputs: FloatArray, a: FloatArray) -> FloatArray:
        """Flow angles at which the force rows give the measured forces, shape (s, 2), rad."""
        columns = slice(RATE_COLUMNS.start, INPUT_COLUMNS.stop)
        angles = [
            (force[:, 1 + k] - rates_inputs @ a[rows.force, columns]) / a[rows.force, rows.angle]
            for k, rows in enumerate(self._rows)
        ]
        return np.asarray(np.clip(np.stack(angles, axis=1), -LARGEST_ANGLE, LARGEST_ANGLE))

    def _restart(self, directions: list[tuple[Vector, float]], told: FloatArray) -> None:
        """Begin where the first samples say that down and the flow are."""
        direction, weight = directions[0]
        if weight > 0.0:
            self.down = direction
        self.angles = told[0].tolist()

    def _turn(self, dt: float, rates: list[float], m: Vector, gain: float) -> None:
        """Turn the direction of gravity with the aircraft, and towards `m`."""
        g = self.down
        e = _cross(m, g)
        integral = 0.25 * ATTITUDE_GAIN * gain * dt  # critically damped
        b = self._bias
        self._bias = b = (b[0] - integral * e[0], b[1] - integral * e[1], b[2] - integral * e[2])
        turn = _cross(
            (
                rates[0] - b[0] + gain * e[0],
                rates[1] - b[1] + gain * e[1],
                rates[2] - b[2] + gain * e[2],
            ),
            g,
        )
        self.down = _unit((g[0] - dt * turn[0], g[1] - dt * turn[1], g[2] - dt * turn[2]))

    def _follow_angles(
        self,
        dt: float,
        rates: list[float],
        force: list[float],
        told: list[float],
        v: float,
        missing: list[list[float]],
    ) -> None:
        """Move the flow angles on, exactly for signals that are constant over `dt`."""
        keep = np.exp(-self._rate * dt)
        by_p, bias = missing
        for k, turning in ((0, -rates[2]), (1, rates[1])):
            rate = turning + (force[1 + k] + GRAVITY * self.down[1 + k]) / v
            rate += by_p[k] * rates[0] + bias[k]
            aim = told[k] + rate / self._rate
            self.angles[k] = float(aim + keep * (self.angles[k] - aim))


def _gravity(force: FloatArray, x: list[list[float]], v: float) -> list[tuple[Vector, float]]:
    """Direction of gravity that each sample tells, and how far it is to be believed, 0 ... 1."""
    out = []
    for (fx, fy, fz), (_, q, r) in zip(force.tolist(), x, strict=True):
        m = (-fx, r * v - fy, -q * v - fz)
        size = (m[0] * m[0] + m[1] * m[1] + m[2] * m[2]) ** 0.5
        weight = max(0.0, 1.0 - abs(size - GRAVITY) / (GRAVITY_BAND * GRAVITY))
        out.append((_unit(m) if size > 0.0 else (0.0, 0.0, 1.0), weight))
    return out


def _signals(
    plan: Steps, angles: list[tuple[float, ...]], downs: list[Vector], v: float
) -> FlowSignals:
    return FlowSignals(plan.at_edges(np.array(angles)), plan.at_edges(np.array(downs)), v)


def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _unit(a: Vector) -> Vector:
    size = (a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) ** 0.5
    return (a[0] / size, a[1] / size, a[2] / size)
