# SPDX-License-Identifier: Apache-2.0
"""A quadrotor in X: four motors that follow their commands with a lag, thrust by speed squared.

A rotor's thrust is ``T = T_max w^2 + c w v_z``, with its speed w as a fraction of the largest and
the velocity v_z along the body's z axis where it is: a rotor that sinks through the air lifts more,
which damps roll, pitch and heave. Its torque is its thrust times a length. Speed follows the
command, 0 ... 1, with a first-order lag. Rotors drag sideways in proportion to the speed. Left out:
the rotors' own inertia (it adds to the yaw moment while they speed up), ground and blockage.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import FloatArray

SIDES = ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0))
"""Forward and right of the centre: motors front right, rear left, front left, rear right."""

SPINS = (1.0, 1.0, -1.0, -1.0)
"""Sense of each rotor's torque on the body: the first two yaw it right."""


@dataclass(frozen=True)
class Body:
    """A quadrotor of 1.5 kg, of the size of the F450."""

    mass: float = 1.5  # kg
    inertia: tuple[float, float, float] = (0.029, 0.029, 0.055)  # Ix, Iy, Iz, kg m^2
    arm: float = 0.16  # Of each motor from the roll and from the pitch axis, m
    hover: float = 0.5  # Command at which it hovers, 0 ... 1
    torque: float = 0.016  # Rotor torque over thrust, m
    inflow: float = 0.6  # c above, N per m/s, at full speed
    drag: float = 0.25  # Sideways force of all rotors, N per m/s
    time_constant: float = 0.05  # Lag of the motors, s

    @property
    def largest_thrust(self) -> float:
        """Thrust of one motor at full speed, N."""
        return self.mass * GRAVITY / (len(SIDES) * self.hover**2)

    def derivatives(self) -> dict[str, float]:
        """Return the true derivatives in hover by name, the inputs as `QUADROTOR` mixes them.

        Those of the inputs are where the motors have followed, in steady state.
        """
        ix, iy, iz = self.inertia
        # thrust of one motor by its command, and by its speed along z
        by_command = 2.0 * self.largest_thrust * self.hover
        by_speed = self.inflow * self.hover
        half = 0.5 * len(SIDES)
        damping = len(SIDES) * by_speed * self.arm**2
        return {
            "pdot/p": -damping / ix,
            "qdot/q": -damping / iy,
            "pdot/da": half * by_command * self.arm / ix,
            "qdot/de": -half * by_command * self.arm / iy,
            "rdot/dr": -half * by_command * self.torque / iz,
        }


class Quadrotor:
    """The state of a quadrotor in flight, and how it goes on."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.rates = [0.0] * 3  # p, q, r, rad/s
        self.angles = [0.0] * 3  # Roll, pitch, yaw, rad
        self.velocity = [0.0] * 3  # u, v, w in body axes, m/s
        self.down = 0.0  # Position below the start, m
        self.speeds = [body.hover] * 4  # Of the motors, 0 ... 1
        self.effect = [1.0] * 4  # What is left of each motor's thrust

    @property
    def sinking(self) -> float:
        """Velocity downwards, m/s."""
        (roll, pitch, _), (u, v, w) = self.angles, self.velocity
        return (
            -math.sin(pitch) * u
            + math.cos(pitch) * (math.sin(roll) * v + math.cos(roll) * w)
        )  # fmt: skip

    def loads(
        self,
        gust: Sequence[float] = (0.0, 0.0, 0.0),  # Its angular acceleration, rad/s^2
    ) -> tuple[list[float], list[float]]:
        """Specific force, m/s^2, and angular acceleration, rad/s^2, as things are."""
        body = self.body
        p, q, r = self.rates
        u, v, w = self.velocity
        total = roll = pitch = yaw = 0.0
        for (ahead, right), spin, speed, effect in zip(
            SIDES, SPINS, self.speeds, self.effect, strict=True
        ):
            sinks = w + p * body.arm * right - q * body.arm * ahead
            thrust = effect * (body.largest_thrust * speed**2 + body.inflow * speed * sinks)
            total += thrust
            roll -= right * body.arm * thrust
            pitch += ahead * body.arm * thrust
            yaw += spin * body.torque * thrust
        ix, iy, iz = body.inertia
        force = [-body.drag * u / body.mass, -body.drag * v / body.mass, -total / body.mass]
        return force, [
            (roll + (iy - iz) * q * r) / ix + gust[0],
            (pitch + (iz - ix) * p * r) / iy + gust[1],
            (yaw + (ix - iy) * p * q) / iz + gust[2],
        ]

    def step(self, commands: Sequence[float], h: float, gust: Sequence[float]) -> None:
        """Go on by `h` s: commands 0 ... 1 of the motors, a gust's angular acceleration, rad/s^2.

        Speeds are exact over the step, the motion is of second order in it.
        """
        before = self.speeds
        decay = math.exp(-0.5 * h / self.body.time_constant)
        aims = [min(max(c, 0.0), 1.0) for c in commands]
        state = (self.rates, self.angles, self.velocity, self.down)
        first = self._slopes(gust)
        self.speeds = [a + (s - a) * decay for s, a in zip(before, aims, strict=True)]
        self._move(state, first, 0.5 * h)
        self._move(state, self._slopes(gust), h)
        self.speeds = [a + (s - a) * decay**2 for s, a in zip(before, aims, strict=True)]

    def _slopes(self, gust: Sequence[float]) -> tuple[list[float], list[float], list[float], float]:
        """Time derivatives of rates, angles, velocity and position."""
        force, acceleration = self.loads(gust)
        (p, q, r), (roll, pitch, _), (u, v, w) = self.rates, self.angles, self.velocity
        turn = q * math.sin(roll) + r * math.cos(roll)
        angles = [
            p + turn * math.tan(pitch),
            q * math.cos(roll) - r * math.sin(roll),
            turn / math.cos(pitch),
        ]
        velocity = [
            force[0] - GRAVITY * math.sin(pitch) - q * w + r * v,
            force[1] + GRAVITY * math.cos(pitch) * math.sin(roll) - r * u + p * w,
            force[2] + GRAVITY * math.cos(pitch) * math.cos(roll) - p * v + q * u,
        ]
        return acceleration, angles, velocity, self.sinking

    def _move(
        self,
        state: tuple[list[float], list[float], list[float], float],
        slopes: tuple[list[float], list[float], list[float], float],
        h: float,
    ) -> None:
        self.rates, self.angles, self.velocity = (
            [x + h * d for x, d in zip(part, slope, strict=True)]
            for part, slope in zip(state[:3], slopes[:3], strict=True)
        )
        self.down = state[3] + h * slopes[3]


@dataclass(frozen=True)
class Hold:
    """An autopilot that holds attitude and height: commands as deviations from hover."""

    # angle, rate: Roll and pitch: input per rad and per rad/s
    angle: float = 0.3
    rate: float = 0.06
    yaw_rate: float = 0.35  # Input per rad/s
    # height, sinking: Collective per m and per m/s
    height: float = 0.05
    sinking: float = 0.08

    def inputs(self, craft: Quadrotor) -> FloatArray:
        """Return de, dr, da, dth."""
        (p, q, r), (roll, pitch, _) = craft.rates, craft.angles
        return np.array(
            [
                self.angle * pitch + self.rate * q,
                self.yaw_rate * r,
                -self.angle * roll - self.rate * p,
                self.height * craft.down + self.sinking * craft.sinking,
            ]
        )
