# SPDX-License-Identifier: Apache-2.0
"""Flights of a quadrotor in hover, on an autopilot that holds attitude and height."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.disturbance import CALM, ColouredNoise
from uav_ident_ros.simulation.flight import Flight, check_positive, sample_count, whole_steps
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.live import LiveQuadrotor
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.quadrotor import Body


@dataclass(frozen=True)
class QuadrotorFlight:
    """Everything that defines a flight of a quadrotor in hover."""

    segments: Sequence[Segment]  # Excitation, added to the autopilot's commands
    duration: float  # s
    rate: float = 1000.0  # Rate of the simulation and of the noise-free samples, Hz
    # Rate of the commands, Hz, a whole fraction of `rate`; each is held until the next
    actuator_rate: float = 250.0
    delay: float = 0.0  # From recorded command to motor, s; a whole number of simulation steps
    time_constant: float = Body.time_constant  # Lag of the motors, s
    gusts: ColouredNoise = CALM  # Angular acceleration, rad/s^2, on each axis
    seed: int = 0  # Seed of the gusts

    def __post_init__(self) -> None:
        check_positive(self, "duration", "rate", "actuator_rate", "time_constant")
        named = f"actuator rate {self.actuator_rate:g} Hz"
        whole_steps(1.0 / self.actuator_rate, self.rate, named)
        whole_steps(self.delay, self.rate, f"delay {self.delay:g} s")


def fly(spec: QuadrotorFlight, name: str = "quadrotor") -> Flight:
    """Fly a quadrotor in hover.

    Raises
    ------
    SimulationError
        If it is lost.
    """
    count, rng = sample_count(spec.duration, spec.rate), np.random.default_rng([spec.seed, 0])
    gusts = spec.gusts.sample(count, 3, spec.rate, rng)
    live = LiveQuadrotor(
        Sensors(rate=spec.actuator_rate), spec.delay, rate=spec.rate,
        body=Body(time_constant=spec.time_constant), gusts=gusts,
    )  # fmt: skip

    def told(_: float, excitation: FloatArray) -> FloatArray:
        return live.motors(excitation + live.hold.inputs(live.craft))

    flown = live.record(spec.segments, spec.duration, told)
    rates, force, acceleration, angles = flown.rows.transpose(1, 0, 2)
    return Flight(
        name=name,
        rates=rates,
        angular_acceleration=acceleration,
        specific_force=force,
        inputs=QUADROTOR.inputs(flown.commands, live.trim),
        trim=live.trim,
        delay=spec.delay,
        time_constant=spec.time_constant,
        local_truth=live.craft.body.derivatives(),
        parameters=PARAMETERS,
        extra={"gust": gusts, "angles": angles},
        **flown.common,
    )


PARAMETERS = {
    "structure": "augmented",
    "fixed_coefficients": ["pdot/ay", "qdot/az", "rdot/ay"],  # no flow angles
    "actuators.thrust_curve": [1.0] * len(QUADROTOR.names),
}
"""Parameters of the identifier that suit it, beside those of its channels."""

AMPLITUDES = dict(zip(INPUTS, (0.02, 0.05, 0.02, 0.03), strict=True))
"""Peaks of an excitation that moves it well and keeps it near hover."""
