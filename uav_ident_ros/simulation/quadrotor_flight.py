# SPDX-License-Identifier: Apache-2.0
"""A quadrotor in flight, and flights in hover on an autopilot that holds attitude and height."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.flight import Flight, SimulationError, check_positive
from uav_ident_ros.simulation.inputs import CALM, ColouredNoise
from uav_ident_ros.simulation.live import SIMULATION_RATE, Live, Plan
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.quadrotor import Body, Hold, Quadrotor

PARAMETERS = {
    "structure": "augmented",
    "fixed_coefficients": ["pdot/ay", "qdot/az", "rdot/ay"],  # no flow angles
    "actuators.thrust_curve": [1.0] * len(QUADROTOR.names),
}
"""Parameters of the identifier that suit it, beside those of its channels."""

AMPLITUDES = dict(zip(INPUTS, (0.02, 0.05, 0.02, 0.03), strict=True))
"""Peaks of an excitation that moves it well and keeps it near hover."""

STILL = (0.0, 0.0, 0.0)


class LiveQuadrotor(Live):
    """A quadrotor in flight, commanded as an aircraft is.

    Elevator, rudder and aileron stand for pitch, yaw and roll: it mixes them into its motors, and
    holds its height itself. Parameters are those of `LiveAircraft`; a row has rates, specific
    force, angular acceleration and angles.
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
        self.craft, self.hold = Quadrotor(body or Body()), Hold()
        self._gusts = iter(() if gusts is None else gusts.tolist())
        self.trim = np.array([0.0, 0.0, 0.0, self.craft.body.hover])
        self._commanded: FloatArray = self.trim[:3]
        self.outputs = self._acting = QUADROTOR.trim(self.trim)
        for fault in faults:
            _motor(fault)

    def apply(self, fault: Fault) -> None:
        """Let a fault happen now; see `Live.apply`."""
        if (motor := _motor(fault)) is None:
            self.craft.effect = [1.0] * len(QUADROTOR.names)
        else:
            self.craft.effect[motor] = fault.value or 0.0

    def motors(self, inputs: FloatArray) -> FloatArray:
        """Motors' commands for de, dr, da, dth, within what they can do."""
        return np.clip(QUADROTOR.raw(inputs, self.trim), 0.0, 1.0)

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        self._commanded = self._commanded if surfaces is None else surfaces
        return self.motors(np.append(self._commanded, self.hold.inputs(self.craft)[3]))

    def _fly(self, acting: FloatArray, moved: bool) -> None:
        craft, gust = self.craft, next(self._gusts, STILL)
        if self.rows is not None:
            self.rows.append((craft.rates, *craft.loads(gust), craft.angles))
        craft.step(acting.tolist(), 1.0 / self.rate, gust)

    def _tilt(self) -> Sequence[float]:
        return self.craft.angles[:2]

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        craft = self.craft
        force, _ = craft.loads()
        surfaces = QUADROTOR.inputs(np.array(craft.speeds), self.trim) + self.trim
        return np.array(craft.rates), np.array(force), np.array(craft.angles), surfaces


def _motor(fault: Fault) -> int | None:
    """Return the motor of a fault; None if all are repaired."""
    if fault.kind == "repaired":
        return None
    if fault.kind != "effect" or fault.what not in QUADROTOR.names:
        raise SimulationError(
            f"fault '{fault.what} {fault.kind}': a quadrotor knows 'MOTOR effect FACTOR', of "
            f"{', '.join(QUADROTOR.names)}, and 'repaired'"
        )
    return QUADROTOR.names.index(fault.what)


@dataclass(frozen=True, kw_only=True)
class QuadrotorFlight(Plan):
    """Flight of a quadrotor in hover."""

    actuator_rate: float = 250.0
    time_constant: float = Body.time_constant  # Lag of the motors, s
    gusts: ColouredNoise = CALM  # Angular acceleration, rad/s^2, on each axis

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, "time_constant")

    def fly(self, name: str = "quadrotor") -> Flight:
        """Fly it; see `Plan.fly`."""
        rng = np.random.default_rng([self.seed, 0])
        gusts = self.gusts.sample(self.samples, 3, self.rate, rng)
        live = LiveQuadrotor(
            Sensors(rate=self.actuator_rate), self.delay, rate=self.rate,
            body=Body(time_constant=self.time_constant), gusts=gusts,
        )  # fmt: skip

        def commanded(_: float, excitation: FloatArray) -> FloatArray:
            return live.motors(excitation + live.hold.inputs(live.craft))

        rows, commands, common = live.record(self, commanded)
        rates, force, acceleration, angles = rows.transpose(1, 0, 2)
        return Flight(
            name=name,
            rates=rates,
            angular_acceleration=acceleration,
            specific_force=force,
            inputs=QUADROTOR.inputs(commands, live.trim),
            trim=live.trim,
            time_constant=self.time_constant,
            local_truth=live.craft.body.derivatives(),
            parameters=PARAMETERS,
            extra={"gust": gusts, "angles": angles},
            **common,
        )
