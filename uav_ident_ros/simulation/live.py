# SPDX-License-Identifier: Apache-2.0
"""The loop over time of every simulated vehicle: commands in, signals out.

Who flies it is up to others: a controller answers Imu samples one at a time (`Live.sample`,
`Live.command`, `Live.advance`), or a whole flight is recorded (`Live.record`).
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.aircraft import COLUMN, FOOT, Aircraft, settle
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.faults import SURFACE_NAMES, Fault, Faults, Schedule
from uav_ident_ros.simulation.flight import sample_count, stamps, whole_steps
from uav_ident_ros.simulation.inputs import Segment, excited_intervals, sample_inputs
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.quadrotor import Body, Hold, Quadrotor

SIMULATION_RATE = 1000.0
"""Rate of the simulation, Hz."""

SPEED_GAIN = 0.05
"""Throttle per m/s of speed error: slow, and strong enough for climbs of a few degrees."""

LARGEST_UPSET = math.radians(85.0)
"""Roll or pitch angle at which the flight counts as lost, rad."""

RANDOM_STREAM = 200
"""First of the random streams of a vehicle in the loop: none that a recorded flight uses."""

STILL = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Sample:
    """What happened and what the Imu measured of it; aircraft axes (FRD), SI units."""

    time: float  # After the first sample, s
    rates: FloatArray  # (3,) True p, q, r, rad/s
    # measured_rates, measured_force: (3,) With bias and noise: rad/s, m/s^2
    measured_rates: FloatArray
    measured_force: FloatArray
    attitude: FloatArray  # (3,) True roll, pitch, yaw, rad
    surfaces: FloatArray  # (4,) Where elevator, rudder, aileron (rad) and throttle are


@dataclass(frozen=True, eq=False)
class Recording:
    """A flight that was recorded."""

    rows: FloatArray  # (N, ...) The row of every step of the simulation
    commands: FloatArray  # (M, C) The outputs of every interval
    common: dict[str, Any]  # What a `Flight` has of any vehicle: stamps and excited intervals


class Live:
    """A vehicle in flight; what it is like is up to `LiveAircraft` and the others.

    Raises
    ------
    SimulationError
        If it cannot be flown, or a rate or the delay is no whole number of simulation steps.
    """

    names: tuple[str, ...]  # Names of the `outputs`
    faults: Schedule  # What has gone wrong with it
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
    ) -> None:
        self._substeps = whole_steps(1.0 / sensors.rate, rate, f"rate {sensors.rate:g} Hz")
        self._delay = whole_steps(delay, rate, f"delay {delay:g} s")
        self._sensors, self.rate = sensors, rate
        self._noise = [np.random.default_rng([seed, RANDOM_STREAM + k]) for k in range(2)]
        self._step = 0
        self._underway: deque[tuple[int, FloatArray]] = deque()
        self.rows: list[Any] | None = None  # Of each step of a recorded flight

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        """Return the outputs for elevator, rudder, aileron, rad; None: the last ones hold."""
        raise NotImplementedError

    def _fly(self, acting: FloatArray, moved: bool) -> None:
        """Fly one step of the simulation and keep its row; `moved` says what may have changed."""
        raise NotImplementedError

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return rates, specific force, attitude and surfaces."""
        raise NotImplementedError

    def _tilt(self) -> Sequence[float]:
        """Return roll and pitch, rad."""
        raise NotImplementedError

    def command(
        self,
        # (3,) Elevator, rudder, aileron, rad; None where no answer came: the last one holds
        surfaces: FloatArray | None,
    ) -> None:
        """Answer the newest sample."""
        self._tell(self._answer(surfaces))

    def _tell(self, outputs: FloatArray) -> None:
        self.outputs = outputs
        self._underway.append((self._step + self._delay, outputs))

    def _advance_step(self, moved: bool = False) -> list[Fault]:
        faults = self.faults.due(self.time)
        moved |= bool(faults)
        while self._underway and self._underway[0][0] <= self._step:
            self._acting, moved = self._underway.popleft()[1], True
        self._fly(self._acting, moved)
        self._step += 1
        return faults

    def _check(self) -> None:
        for name, angle in zip(("roll", "pitch"), self._tilt(), strict=True):
            if not abs(angle) < LARGEST_UPSET:  # NaN fails too
                raise SimulationError(
                    f"the vehicle is lost at {self.time:.1f} s: its {name}. Smaller commands, "
                    "weaker gusts or less delay would keep it"
                )

    def advance(self) -> list[Fault]:
        """Fly on to the next sample; return the faults that came at their time.

        Raises
        ------
        SimulationError
            If it is lost.
        """
        faults = self._advance_step(moved=True)  # a fault at once may have moved them
        for _ in range(1, self._substeps):
            faults += self._advance_step()
        self._check()
        return faults

    def record(
        self,
        segments: Sequence[Segment],  # Excitation
        duration: float,  # s
        # The outputs of an interval, within their limits, from its time (s) and excitation
        told: Callable[[float, FloatArray], FloatArray],
    ) -> Recording:
        """Fly on and keep everything.

        Raises
        ------
        SimulationError
            If it is lost.
        """
        count = sample_count(duration, self.rate)
        times = np.arange(0, count, self._substeps) / self.rate
        excitation = sample_inputs(segments, times)
        commands: list[FloatArray] = []
        self.rows = []
        for step in range(count):
            if step % self._substeps == 0:
                self._check()
                k = len(commands)
                commands.append(told(float(times[k]), excitation[k]))
                self._tell(commands[-1])
            self._advance_step()
        common = {
            "t_ns": stamps(np.arange(count) / self.rate),
            "actuator_t_ns": stamps(times),
            "excitation": excited_intervals(segments, duration),
        }
        return Recording(np.array(self.rows), np.array(commands), common)

    @property
    def time(self) -> float:
        """Time of the newest sample, s after the first."""
        return self._step / self.rate

    def sample(self) -> Sample:
        """Measure it as it is; to be called once for each sample."""
        rates, force, attitude, surfaces = self._state()
        gyro, accelerometer = (rng.standard_normal(3) for rng in self._noise)
        sensors = self._sensors
        return Sample(
            time=self.time,
            rates=rates,
            measured_rates=rates + np.asarray(sensors.gyro_bias) + sensors.gyro_noise * gyro,
            measured_force=force + sensors.accelerometer_noise * accelerometer,
            attitude=attitude,
            surfaces=surfaces,
        )


class LiveAircraft(Live):
    """A JSBSim aircraft in flight; a row has its signals, in JSBSim's units."""

    names = SURFACE_NAMES

    def __init__(
        self,
        name: str,  # As in `uav_ident_ros.simulation.airframe`
        sensors: Sensors,  # sensors, delay, seed, rate: As in `Live`
        delay: float = 0.0,
        faults: Sequence[Fault] = (),  # Those that come at a time of their own
        seed: int = 0,
        speed: float | None = None,  # True airspeed in place of the aircraft's own, m/s
        rate: float = SIMULATION_RATE,
    ) -> None:
        super().__init__(sensors, delay, seed, rate)
        self.aircraft = Aircraft(name, rate, speed)  # JSBSim's aircraft
        self.autopilot, self.signals = settle(self.aircraft, sensors.rate)
        self.trim = self.outputs = self._acting = self.aircraft.surfaces
        self._airspeed = self.signals[COLUMN["airspeed"]]
        self._state_of_faults = Faults(self.aircraft, self.trim, seed)
        self.faults = Schedule(faults, self._state_of_faults.apply)

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        slow = (self._airspeed - self.signals[COLUMN["airspeed"]]) * FOOT
        told = self.outputs[:3] if surfaces is None else surfaces
        return self.aircraft.clip(np.append(told, self.trim[3] + SPEED_GAIN * slow))

    def _fly(self, acting: FloatArray, moved: bool) -> None:
        if moved:
            self.aircraft.set_surfaces(self._state_of_faults.surfaces(acting))
        self.signals = self.aircraft.step()
        if self.rows is not None:
            self.rows.append(self.signals)

    def _tilt(self) -> Sequence[float]:
        return self.signals[COLUMN["roll"]], self.signals[COLUMN["pitch"]]

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        signals = self.aircraft.to_si(np.array(self.signals))
        attitude, surfaces = (
            signals[[COLUMN[name] for name in names]]
            for names in (("roll", "pitch", "yaw"), SURFACE_NAMES)
        )
        return signals[0:3], signals[6:9], attitude, surfaces


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
        super().__init__(sensors, delay, seed, rate)
        self.craft, self.hold = Quadrotor(body or Body()), Hold()
        self._gusts = iter(() if gusts is None else gusts.tolist())
        self.trim = np.array([0.0, 0.0, 0.0, self.craft.body.hover])
        self._told: FloatArray = self.trim[:3]
        self.outputs = self._acting = QUADROTOR.trim(self.trim)
        for fault in faults:
            _motor(fault)
        self.faults = Schedule(faults, self._fail)

    def _fail(self, fault: Fault) -> None:
        if (motor := _motor(fault)) is None:
            self.craft.effect = [1.0] * len(QUADROTOR.names)
        else:
            self.craft.effect[motor] = fault.value or 0.0

    def motors(self, inputs: FloatArray) -> FloatArray:
        """Motors' commands for de, dr, da, dth, within what they can do."""
        return np.clip(QUADROTOR.raw(inputs, self.trim), 0.0, 1.0)

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        self._told = self._told if surfaces is None else surfaces
        return self.motors(np.append(self._told, self.hold.inputs(self.craft)[3]))

    def _fly(self, acting: FloatArray, moved: bool) -> None:
        craft, gust = self.craft, next(self._gusts, STILL)
        if self.rows is not None:
            craft.look(gust)
            self.rows.append((craft.rates, craft.force, craft.acceleration, craft.angles))
        craft.step(acting.tolist(), 1.0 / self.rate, gust)

    def _tilt(self) -> Sequence[float]:
        return self.craft.angles[:2]

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        craft = self.craft
        craft.look(STILL)
        surfaces = QUADROTOR.inputs(np.array(craft.speeds), self.trim) + self.trim
        return np.array(craft.rates), np.array(craft.force), np.array(craft.angles), surfaces


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
