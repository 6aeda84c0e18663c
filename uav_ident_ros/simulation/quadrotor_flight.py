# SPDX-License-Identifier: Apache-2.0
"""A quadrotor in X, and its flights in hover under an attitude and height hold."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, repeat

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.flight import Flight, SimulationError
from uav_ident_ros.simulation.inputs import CALM, ColouredNoise
from uav_ident_ros.simulation.live import SIMULATION_RATE, Live, Plan
from uav_ident_ros.simulation.noise import Sensors

NAME = "quadrotor"
"""Its name among the plants and the aircraft."""

SIDES = ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0))
"""Motor positions, forward and right, in arms: front right, rear left, front left, rear right."""

SPINS = (1.0, 1.0, -1.0, -1.0)
"""Sign of each rotor's yawing torque on the body, positive to the right."""


@dataclass(frozen=True)
class Body:
    """Parameters of a quadrotor of 1.5 kg, of the size of the F450."""

    mass: float = 1.5  # kg
    inertia: tuple[float, float, float] = (0.029, 0.029, 0.055)  # Ix, Iy, Iz, kg m^2
    arm: float = 0.16  # Of each motor from the roll and from the pitch axis, m
    hover: float = 0.5  # Motor command in hover, 0 ... 1
    torque: float = 0.016  # Rotor torque over thrust, m
    inflow: float = 0.6  # c of `LiveQuadrotor`, N per m/s, at full speed
    drag: float = 0.25  # Sideways force of all rotors, N per m/s
    time_constant: float = 0.05  # Lag of the motors, s

    @property
    def largest_thrust(self) -> float:
        """Thrust of one motor at full speed, N."""
        return self.mass * GRAVITY / (len(SIDES) * self.hover**2)

    def derivatives(self) -> dict[str, float]:
        """Return the true derivatives in hover by name, for the mixing of `QUADROTOR`.

        Control derivatives hold in steady state, after the lag of the motors.
        """
        ix, iy, iz = self.inertia
        # derivatives of a motor's thrust: by its command, and by its velocity along z
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


TILT_GAIN, TILT_RATE_GAIN, YAW_GAIN = 0.3, 0.06, 0.35
"""Gains of the autopilot: input per rad and per rad/s of roll and pitch, and per rad/s of yaw."""

HEIGHT_GAIN, SINKING_GAIN = 0.05, 0.08
"""Collective per m and per m/s."""


QUADROTOR_SETTINGS = {
    "structure": "augmented",
    "fixed_coefficients": ["pdot/ay", "qdot/az", "rdot/ay"],  # no flow angles
    "actuators.thrust_curve": [1.0] * len(QUADROTOR.names),
}
"""Parameters of the identifier for the quadrotor, except those of its channels."""

AMPLITUDES = dict(zip(INPUTS, (0.02, 0.05, 0.02, 0.03), strict=True))
"""Peaks of a sufficient excitation near hover."""


class LiveQuadrotor(Live):
    """A quadrotor in flight, with the commands of an aircraft.

    A rotor's thrust is ``T = T_max w^2 + c w v_z``, with its speed w as a fraction of the largest
    and its velocity v_z along the body's z axis. A rotor that sinks through the air has more
    thrust, which damps roll, pitch and heave. Its torque is its thrust times a length. Its speed
    follows the command, 0 ... 1, with a first-order lag. Rotor drag is proportional to sideways
    velocity. Not modelled: rotor inertia (a yaw moment while the speed changes), ground effect and
    blockage.

    Elevator, rudder and aileron stand for pitch, yaw and roll, and are mixed into the motors. The
    quadrotor holds its height. Parameters are those of `LiveAircraft`. A recorded row goes on
    with specific force and angles.
    """

    names = QUADROTOR.names

    def __init__(
        self,
        sensors: Sensors,
        delay: float = 0.0,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        rate: float = SIMULATION_RATE,
        body: Body | None = None,
        gusts: FloatArray | None = None,  # (N, 3) Angular acceleration of each step, rad/s^2
    ) -> None:
        super().__init__(sensors, delay, seed, rate, faults)
        self.body = body or Body()
        # p q r, rad/s; roll pitch yaw, rad; u v w in body axes, m/s; position below the start, m
        self.state = [0.0] * 10
        self.speeds = [self.body.hover] * 4  # Of the motors, 0 ... 1
        self.effect = [1.0] * 4  # Remaining share of each motor's thrust
        self._gusts = chain([] if gusts is None else gusts.tolist(), repeat([0.0] * 3))
        self.trim = np.array([0.0, 0.0, 0.0, self.body.hover])
        self._commanded: FloatArray = self.trim[:3]
        self.outputs = self._acting = QUADROTOR.trim(self.trim)

    def check(self, fault: Fault) -> None:
        """Refuse a fault of anything but a motor; see `Live.check`."""
        of_motor = fault.kind == "effect" and fault.what in self.names
        if not (of_motor or fault.kind == "repaired"):
            raise SimulationError(
                f"fault '{fault}': a quadrotor knows 'MOTOR effect FACTOR', of "
                f"{', '.join(self.names)}, and 'repaired'"
            )

    def _apply(self, fault: Fault) -> None:
        if fault.kind == "repaired":
            self.effect = [1.0] * len(self.names)
        else:
            self.effect[self.names.index(fault.what)] = fault.value or 0.0

    def motors(self, inputs: FloatArray) -> FloatArray:
        """Return the motors' commands for de, dr, da, dth, within 0 ... 1."""
        return np.clip(QUADROTOR.raw(inputs, self.trim), 0.0, 1.0)

    def hold(self) -> FloatArray:
        """Return de, dr, da, dth that hold attitude and height, as deviations from hover."""
        p, q, r, roll, pitch, *_, down = self.state
        return np.array(
            [
                TILT_GAIN * pitch + TILT_RATE_GAIN * q,
                YAW_GAIN * r,
                -TILT_GAIN * roll - TILT_RATE_GAIN * p,
                HEIGHT_GAIN * down + SINKING_GAIN * self._sinking,
            ]
        )

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        self._commanded = self._commanded if surfaces is None else surfaces
        return self.motors(np.append(self._commanded, self.hold()[3]))

    def _attitude(self) -> Sequence[float]:
        return self.state[3:6]

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray, None]:
        surfaces = QUADROTOR.inputs(np.array(self.speeds), self.trim) + self.trim
        return np.array(self.state[:3]), np.array(self.loads()[0]), surfaces, None

    @property
    def _sinking(self) -> float:
        """Return the downward velocity, m/s."""
        roll, pitch, _, u, v, w, _ = self.state[3:]
        return (
            -math.sin(pitch) * u
            + math.cos(pitch) * (math.sin(roll) * v + math.cos(roll) * w)
        )  # fmt: skip

    def loads(
        self,
        gust: Sequence[float] = (0.0, 0.0, 0.0),  # Angular acceleration by it, rad/s^2
    ) -> tuple[list[float], list[float]]:
        """Return specific force, m/s^2, and angular acceleration, rad/s^2, in the present state."""
        body = self.body
        p, q, r, *_, u, v, w, _ = self.state
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

    def _fly(self, acting: FloatArray, moved: bool) -> list[float]:
        """Simulate one step: motor speeds exactly, the motion to second order."""
        h, gust = 1.0 / self.rate, next(self._gusts)
        state, before = self.state, self.speeds
        decay = math.exp(-0.5 * h / self.body.time_constant)
        aims = [min(max(c, 0.0), 1.0) for c in acting.tolist()]
        force, acceleration = self.loads(gust)
        half = self._slopes(force, acceleration)
        self.speeds = [a + (s - a) * decay for s, a in zip(before, aims, strict=True)]
        self.state = [x + 0.5 * h * d for x, d in zip(state, half, strict=True)]
        whole = self._slopes(*self.loads(gust))
        self.state = [x + h * d for x, d in zip(state, whole, strict=True)]
        self.speeds = [a + (s - a) * decay**2 for s, a in zip(before, aims, strict=True)]
        return [*state[:3], *acceleration, *force, *state[3:6]]

    def _slopes(self, force: list[float], acceleration: list[float]) -> list[float]:
        """Return the time derivative of the state."""
        p, q, r, roll, pitch, _, u, v, w, _ = self.state
        turn = q * math.sin(roll) + r * math.cos(roll)
        return [
            *acceleration,
            p + turn * math.tan(pitch),
            q * math.cos(roll) - r * math.sin(roll),
            turn / math.cos(pitch),
            force[0] - GRAVITY * math.sin(pitch) - q * w + r * v,
            force[1] + GRAVITY * math.cos(pitch) * math.sin(roll) - r * u + p * w,
            force[2] + GRAVITY * math.cos(pitch) * math.cos(roll) - p * v + q * u,
            self._sinking,
        ]


@dataclass(frozen=True, kw_only=True)
class QuadrotorFlight(Plan):
    """Flight of a quadrotor in hover."""

    actuator_rate: float = 250.0
    time_constant: float = Body.time_constant  # Lag of the motors, s
    gusts: ColouredNoise = CALM  # Angular acceleration, rad/s^2, on each axis

    def fly(self, name: str = NAME) -> Flight:
        """Fly it; see `Plan.fly`."""
        rng = np.random.default_rng([self.seed, 0])
        gusts = self.gusts.sample(self.samples, 3, self.rate, rng)
        live = LiveQuadrotor(
            Sensors(rate=self.actuator_rate), self.delay, rate=self.rate,
            body=Body(time_constant=self.time_constant), gusts=gusts,
        )  # fmt: skip

        def commanded(_: float, excitation: FloatArray) -> FloatArray:
            return live.motors(excitation + live.hold())

        rows, commands, common = live.record(self, commanded)
        return Flight(
            name=name,
            specific_force=rows[:, 6:9],
            inputs=QUADROTOR.inputs(commands, live.trim),
            trim=live.trim,
            channel_set=QUADROTOR,
            local_truth=live.body.derivatives(),
            parameters=QUADROTOR_SETTINGS,
            extra={"gust": gusts, "angles": rows[:, 9:12]},
            **common,
        )
