# SPDX-License-Identifier: Apache-2.0
"""The time loop of every simulated vehicle: commands in, signals out.

Either a controller commands the vehicle sample by sample (`Live.sample`, `Live.command`,
`Live.advance`), or a whole flight is recorded by a `Plan`.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.flight import (
    STEP_TOLERANCE,
    Flight,
    SimulationError,
    check_positive,
    stamps,
    whole_steps,
)
from uav_ident_ros.simulation.inputs import Segment, sample_inputs
from uav_ident_ros.simulation.noise import Sensors, airspeed_step

SIMULATION_RATE = 1000.0
"""Rate of the simulation, Hz."""

LARGEST_UPSET = math.radians(85.0)
"""Roll or pitch angle at which the flight counts as lost, rad."""

RANDOM_STREAM = 200
"""First random stream of a vehicle in the loop; recorded flights use lower numbers."""


@dataclass(frozen=True)
class Sample:
    """True and measured signals at an Imu sample; aircraft axes (FRD), SI units."""

    time: float  # After the first sample, s
    rates: FloatArray  # (3,) True p, q, r, rad/s
    # measured_rates, measured_force: (3,) With bias and noise: rad/s, m/s^2
    measured_rates: FloatArray
    measured_force: FloatArray
    # With bias and noise, m/s; None without a sensor, and between the samples of its slower rate
    measured_airspeed: float | None
    attitude: FloatArray  # (3,) True roll, pitch, yaw, rad
    surfaces: FloatArray  # (4,) True elevator, rudder, aileron (rad) and throttle


def obeyed(before: FloatArray, commanded: FloatArray) -> FloatArray:
    """Return the position that perfect actuators take after `before` with a command."""
    return commanded


@dataclass(frozen=True)
class Plan:
    """Definition of a recorded flight; each kind of vehicle adds fields."""

    segments: Sequence[Segment]  # Excitation, added to the autopilot's commands
    duration: float  # Length of the record, s
    rate: float = SIMULATION_RATE  # Rate of the noise-free samples, Hz
    actuator_rate: float = 100.0  # Rate of the commands, Hz; each is held until the next
    delay: float = 0.0  # Transport delay from recorded command to surface or motor, s
    seed: int = 0  # Seed of the disturbances
    time_constant: float = 0.0  # First-order lag of the surfaces or motors, s
    # Position of the actuators after the last one with a recorded command, before delay and lag:
    # for backlash, dead bands and linkages
    actuators: Callable[[FloatArray, FloatArray], FloatArray] = obeyed

    def __post_init__(self) -> None:
        check_positive(self, "duration", "rate", "actuator_rate")
        check_positive(self, "delay", "time_constant", or_zero=True)
        if self.samples < 2:
            raise SimulationError(
                f"a duration of {self.duration} s holds no two samples at {self.rate} Hz"
            )

    @property
    def samples(self) -> int:
        """Number of the noise-free samples, first and last included."""
        return math.floor(self.duration * self.rate + STEP_TOLERANCE) + 1

    def fly(
        self,
        name: str = "",  # Name of the result; the vehicle's by default
    ) -> Flight:
        """Simulate the flight and return its record."""
        raise NotImplementedError


class Live:
    """A vehicle in flight; the subclasses hold its dynamics."""

    names: tuple[str, ...]  # Names of the `outputs`
    # (4,) Elevator, rudder, aileron (rad) and throttle in the initial steady flight
    trim: FloatArray
    # Last commands of the actuators, within their limits. With `command` the vehicle sets its own
    # throttle, which holds airspeed or height
    outputs: FloatArray
    _acting: FloatArray

    def __init__(
        self,
        sensors: Sensors,  # Rate of the samples, noise and bias
        delay: float,  # From a sample to the action of its command on the surface or motor, s
        seed: int,  # Seed of the noise
        rate: float = SIMULATION_RATE,  # Of the simulation, Hz
        faults: Sequence[Fault] = (),  # With their times
    ) -> None:
        self._substeps = whole_steps(1.0 / sensors.rate, rate, f"rate {sensors.rate:g} Hz")
        self._delay = whole_steps(delay, rate, f"delay {delay:g} s")
        self.sensors, self.rate = sensors, rate
        self._noise = [np.random.default_rng([seed, RANDOM_STREAM + k]) for k in range(3)]
        self._ahead = deque(sorted(faults, key=lambda fault: fault.time))
        for fault in faults:
            self.check(fault)
        self._step = 0
        self._underway: deque[tuple[int, FloatArray]] = deque()

    def check(self, fault: Fault) -> None:
        """Raise SimulationError if the vehicle cannot have a fault."""

    def apply(self, fault: Fault) -> None:
        """Apply a fault now, after a `check`."""
        self.check(fault)
        self._apply(fault)

    def _apply(self, fault: Fault) -> None:
        """Apply a fault that the vehicle can have."""
        raise NotImplementedError

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        """Return the outputs for elevator, rudder, aileron, rad; None holds the last ones."""
        raise NotImplementedError

    def _fly(self, acting: FloatArray, moved: bool) -> Any:
        """Simulate one step; return its row of a recorded flight.

        A row begins with the rates and their derivatives. `moved` is false if neither the acting
        outputs nor the faults have changed.
        """
        raise NotImplementedError

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray, float | None]:
        """Return rates, specific force, surfaces, and true airspeed, m/s, if there is a pitot."""
        raise NotImplementedError

    def _attitude(self) -> Sequence[float]:
        """Return roll, pitch, yaw, rad; nothing if there is no attitude, and so no upset."""
        return ()

    def command(
        self,
        # (3,) Elevator, rudder, aileron, rad; None, without a command, holds the last one
        surfaces: FloatArray | None,
    ) -> None:
        """Set the command that answers the newest sample."""
        self._send(self._answer(surfaces))

    def _send(self, outputs: FloatArray) -> None:
        self.outputs = outputs
        self._underway.append((self._step + self._delay, outputs))

    def _advance_step(self, moved: bool = False) -> Any:
        while self._ahead and self._ahead[0].time <= self.time:
            self.apply(self._ahead.popleft())
            moved = True
        while self._underway and self._underway[0][0] <= self._step:
            self._acting, moved = self._underway.popleft()[1], True
        row = self._fly(self._acting, moved)
        self._step += 1
        return row

    def _check(self) -> None:
        for name, angle in zip(("roll", "pitch"), self._attitude(), strict=False):
            if not abs(angle) < LARGEST_UPSET:  # NaN fails too
                raise SimulationError(
                    f"the vehicle is lost at {self.time:.1f} s: its {name}. Smaller commands, "
                    "weaker gusts or less delay would keep it"
                )

    def advance(self) -> list[Fault]:
        """Simulate up to the next sample; return the faults that were due."""
        ahead = list(self._ahead)
        self._advance_step(moved=True)  # an immediate fault may have moved the surfaces
        for _ in range(1, self._substeps):
            self._advance_step()
        self._check()
        return ahead[: len(ahead) - len(self._ahead)]

    def record(
        self,
        plan: Plan,
        # Returns the outputs of an interval, within their limits, for its time (s) and excitation
        commanded: Callable[[float, FloatArray], FloatArray],
    ) -> tuple[FloatArray, FloatArray, dict[str, Any]]:
        """Fly a plan and record it.

        Returns the rows of all samples, the outputs of all intervals, and the fields of a `Flight`
        common to all vehicles.
        """
        every = round(self.rate / plan.rate)
        count = (plan.samples - 1) * every + 1
        times = np.arange(0, count, self._substeps) / self.rate
        excitation = sample_inputs(plan.segments, times)
        rows: list[Any] = []
        commands: list[FloatArray] = []
        reached = np.empty(0)
        for step in range(count):
            if step % self._substeps == 0:
                self._check()
                k = len(commands)
                commands.append(commanded(float(times[k]), excitation[k]))
                reached = plan.actuators(reached if k else commands[0], commands[-1])
                self._send(reached)
            row = self._advance_step()
            if step % every == 0:
                rows.append(row)
        table = np.array(rows)
        common = {
            "t_ns": stamps(np.arange(plan.samples) / plan.rate),
            "rates": table[:, 0:3],
            "angular_acceleration": table[:, 3:6],
            "actuator_t_ns": stamps(times),
            "injected": excitation,
            "delay": plan.delay,
            "time_constant": plan.time_constant,
        }
        return table, np.array(commands), common

    @property
    def time(self) -> float:
        """Time of the newest sample, s after the first."""
        return self._step / self.rate

    def sample(self) -> Sample:
        """Return a measurement of the present state; call it once for each sample."""
        sensors, (rates, force, surfaces, airspeed) = self.sensors, self._state()
        gyro, accelerometer = (rng.standard_normal(3) for rng in self._noise[:2])
        between = self._step % (self._substeps * airspeed_step(sensors.rate))
        if airspeed is None or sensors.airspeed_noise is None or between:
            airspeed = None
        else:
            error = sensors.airspeed_noise * float(self._noise[2].standard_normal())
            airspeed = airspeed + sensors.airspeed_bias + error
        return Sample(
            time=self.time,
            rates=rates,
            measured_rates=rates + np.asarray(sensors.gyro_bias) + sensors.gyro_noise * gyro,
            measured_force=force + sensors.accelerometer_noise * accelerometer,
            measured_airspeed=airspeed,
            attitude=np.array(self._attitude()),
            surfaces=surfaces,
        )
