# SPDX-License-Identifier: Apache-2.0
"""The loop over time of every simulated vehicle: commands in, signals out.

Who flies it is up to others: a controller answers Imu samples one at a time (`Live.sample`,
`Live.command`, `Live.advance`), or a whole flight is recorded as a `Plan` says.
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
from uav_ident_ros.simulation.inputs import Segment, excited_intervals, sample_inputs
from uav_ident_ros.simulation.noise import Sensors, airspeed_step

SIMULATION_RATE = 1000.0
"""Rate of the simulation, Hz."""

LARGEST_UPSET = math.radians(85.0)
"""Roll or pitch angle at which the flight counts as lost, rad."""

RANDOM_STREAM = 200
"""First of the random streams of a vehicle in the loop: none that a recorded flight uses."""


@dataclass(frozen=True)
class Sample:
    """What happened and what the Imu measured of it; aircraft axes (FRD), SI units."""

    time: float  # After the first sample, s
    rates: FloatArray  # (3,) True p, q, r, rad/s
    # measured_rates, measured_force: (3,) With bias and noise: rad/s, m/s^2
    measured_rates: FloatArray
    measured_force: FloatArray
    # With bias and noise, m/s; None without a sensor, and where its slower rate has no sample
    measured_airspeed: float | None
    attitude: FloatArray  # (3,) True roll, pitch, yaw, rad
    surfaces: FloatArray  # (4,) Where elevator, rudder, aileron (rad) and throttle are


@dataclass(frozen=True)
class Plan:
    """What defines every recorded flight; each kind of vehicle has fields of its own, too."""

    segments: Sequence[Segment]  # Excitation, added to the autopilot's commands
    duration: float  # Length of the record, s
    rate: float = SIMULATION_RATE  # Rate of the noise-free samples, Hz
    actuator_rate: float = 100.0  # Rate of the commands, Hz; each is held until the next
    delay: float = 0.0  # From recorded command to surface or motor, s
    seed: int = 0  # Seed of the disturbances
    time_constant: float = 0.0  # First-order lag of the surfaces or motors, s

    def __post_init__(self) -> None:
        check_positive(self, "duration", "rate", "actuator_rate")
        for name in ("delay", "time_constant"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise SimulationError(f"{name} is {getattr(self, name)} s: it must be 0 or more")
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
        """Fly it."""
        raise NotImplementedError


class Live:
    """A vehicle in flight; what it is like is up to its kinds."""

    names: tuple[str, ...]  # Names of the `outputs`
    # (4,) Elevator, rudder, aileron (rad) and throttle of the steady flight that it starts in
    trim: FloatArray
    # What the actuators were told last, within their limits. Of `command` the throttle is its own:
    # it holds airspeed or height
    outputs: FloatArray
    _acting: FloatArray

    def __init__(
        self,
        sensors: Sensors,  # Rate of the samples, noise and bias
        delay: float,  # From a sample to the surface or motor that its command moves, s
        seed: int,  # Seed of the noise
        rate: float = SIMULATION_RATE,  # Of the simulation, Hz
        faults: Sequence[Fault] = (),  # Those that come at a time of their own
    ) -> None:
        self._substeps = whole_steps(1.0 / sensors.rate, rate, f"rate {sensors.rate:g} Hz")
        self._delay = whole_steps(delay, rate, f"delay {delay:g} s")
        self._sensors, self.rate = sensors, rate
        self._noise = [np.random.default_rng([seed, RANDOM_STREAM + k]) for k in range(3)]
        self._ahead = deque(sorted(faults, key=lambda fault: fault.time))
        self._step = 0
        self._underway: deque[tuple[int, FloatArray]] = deque()

    def apply(self, fault: Fault) -> None:
        """Let a fault happen now, or refuse one that this vehicle cannot have."""
        raise NotImplementedError

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        """Return the outputs for elevator, rudder, aileron, rad; None: the last ones hold."""
        raise NotImplementedError

    def _fly(self, acting: FloatArray, moved: bool) -> Any:
        """Fly one step of the simulation; return what a recorded flight keeps of it.

        `moved` says whether what acts, or what it does, may have changed.
        """
        raise NotImplementedError

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rates, specific force and surfaces."""
        raise NotImplementedError

    def _attitude(self) -> Sequence[float]:
        """Return roll, pitch, yaw, rad."""
        raise NotImplementedError

    def _airspeed(self) -> float | None:
        """Return the true airspeed, m/s; None of what carries no pitot tube."""
        return None

    def command(
        self,
        # (3,) Elevator, rudder, aileron, rad; None where no answer came: the last one holds
        surfaces: FloatArray | None,
    ) -> None:
        """Answer the newest sample."""
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
        """Fly on to the next sample; return the faults that came at their time."""
        ahead = list(self._ahead)
        self._advance_step(moved=True)  # a fault at once may have moved them
        for _ in range(1, self._substeps):
            self._advance_step()
        self._check()
        return ahead[: len(ahead) - len(self._ahead)]

    def record(
        self,
        plan: Plan,
        # The outputs of an interval, within their limits, from its time (s) and excitation
        commanded: Callable[[float, FloatArray], FloatArray],
    ) -> tuple[FloatArray, FloatArray, dict[str, Any]]:
        """Fly on and keep everything.

        Returns the rows of all samples, the outputs of all intervals, and what a `Flight` has of
        any vehicle.
        """
        every = round(self.rate / plan.rate)
        count = (plan.samples - 1) * every + 1
        times = np.arange(0, count, self._substeps) / self.rate
        excitation = sample_inputs(plan.segments, times)
        rows: list[Any] = []
        commands: list[FloatArray] = []
        for step in range(count):
            if step % self._substeps == 0:
                self._check()
                k = len(commands)
                commands.append(commanded(float(times[k]), excitation[k]))
                self._send(commands[-1])
            row = self._advance_step()
            if step % every == 0:
                rows.append(row)
        common = {
            "t_ns": stamps(np.arange(plan.samples) / plan.rate),
            "actuator_t_ns": stamps(times),
            "injected": excitation,
            "delay": plan.delay,
            "time_constant": plan.time_constant,
            "excitation": excited_intervals(plan.segments, (plan.samples - 1) / plan.rate),
        }
        return np.array(rows), np.array(commands), common

    @property
    def time(self) -> float:
        """Time of the newest sample, s after the first."""
        return self._step / self.rate

    @property
    def period(self) -> float:
        """Time from one sample to the next, s."""
        return 1.0 / self._sensors.rate

    def sample(self) -> Sample:
        """Measure it as it is; to be called once for each sample."""
        sensors, (rates, force, surfaces) = self._sensors, self._state()
        gyro, accelerometer = (rng.standard_normal(3) for rng in self._noise[:2])
        return Sample(
            time=self.time,
            rates=rates,
            measured_rates=rates + np.asarray(sensors.gyro_bias) + sensors.gyro_noise * gyro,
            measured_force=force + sensors.accelerometer_noise * accelerometer,
            measured_airspeed=self._measured_airspeed(),
            attitude=np.array(self._attitude()),
            surfaces=surfaces,
        )

    def _measured_airspeed(self) -> float | None:
        sensors, airspeed = self._sensors, self._airspeed()
        every = self._substeps * airspeed_step(sensors.rate)
        if airspeed is None or sensors.airspeed_noise is None or self._step % every:
            return None
        error = sensors.airspeed_noise * float(self._noise[2].standard_normal())
        return airspeed + sensors.airspeed_bias + error
