# SPDX-License-Identifier: Apache-2.0
"""An aircraft that others fly: commands in, Imu samples out, one interval at a time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.aircraft import COLUMN, FOOT, Aircraft, settle
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.faults import SURFACE_NAMES, Fault, Faults
from uav_ident_ros.simulation.noise import Sensors

SIMULATION_RATE = 1000.0
"""Rate of the simulation, Hz."""

SPEED_GAIN = 0.05
"""Throttle per m/s of speed error: slow, and strong enough for climbs of a few degrees."""

LARGEST_UPSET = math.radians(85.0)
"""Roll or pitch angle at which the flight counts as lost, rad."""

RANDOM_STREAM = 200
"""First of the random streams of an aircraft in the loop: none that a recorded flight uses."""


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


class LiveAircraft:
    """A JSBSim aircraft in the loop.

    Parameters
    ----------
    name : str
        As in `uav_ident_ros.simulation.airframe`.
    sensors : Sensors
        Rate of the samples, noise and bias.
    delay : float
        From a sample to the surface that its command moves, s.
    faults : sequence of Fault
        Those that come at a time of their own.
    seed : int
        Seed of noise and turbulence.
    speed : float, optional
        True airspeed in place of the aircraft's own, m/s.

    Attributes
    ----------
    aircraft : Aircraft
        JSBSim's aircraft.
    faults : Faults
        What has gone wrong with it.
    names : tuple of str
        Names of the `outputs`.
    trim : (4,) array
        Elevator, rudder, aileron (rad) and throttle of the steady flight that it starts in.
    outputs : (4,) array
        What the actuators were told last, within their limits. The throttle is the aircraft's
        own: it holds the airspeed.

    Raises
    ------
    SimulationError
        If it cannot be flown, or a rate or the delay is no whole number of simulation steps.
    """

    names = SURFACE_NAMES

    def __init__(
        self,
        name: str,
        sensors: Sensors,
        delay: float = 0.0,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        speed: float | None = None,
    ) -> None:
        self._substeps = whole(SIMULATION_RATE / sensors.rate, f"Imu rate {sensors.rate:g} Hz")
        self._delay = whole(delay * SIMULATION_RATE, f"delay {delay:g} s")
        self.aircraft = Aircraft(name, SIMULATION_RATE, speed)
        self._sensors = sensors
        self._noise = [np.random.default_rng([seed, RANDOM_STREAM + k]) for k in range(2)]
        self._step = 0
        self._signals = settle(self.aircraft)
        self.trim: FloatArray = self.aircraft.surfaces
        self.outputs: FloatArray = self.trim
        self._airspeed = self._signals[COLUMN["airspeed"]]
        self._acting = self.trim
        self._underway: deque[tuple[int, FloatArray]] = deque()
        self.faults = Faults(self.aircraft, self.trim, seed, faults)

    def command(self, surfaces: FloatArray | None) -> None:
        """Answer the newest sample.

        Parameters
        ----------
        surfaces : (3,) array or None
            Elevator, rudder, aileron, rad; None where no answer came: the last one holds.
        """
        slow = (self._airspeed - self._signals[COLUMN["airspeed"]]) * FOOT
        throttle = self.trim[3] + SPEED_GAIN * slow
        told = self.outputs[:3] if surfaces is None else surfaces
        self.outputs = self.aircraft.clip(np.append(told, throttle))
        self._underway.append((self._step + self._delay, self.outputs))

    def advance(self) -> list[Fault]:
        """Fly on to the next sample; return the faults that came at their time.

        Raises
        ------
        SimulationError
            If the aircraft is lost.
        """
        faults = self.faults.due(self.time)
        moved = True  # a fault may have moved them
        for _ in range(self._substeps):
            while self._underway and self._underway[0][0] <= self._step:
                self._acting, moved = self._underway.popleft()[1], True
            if moved:
                self.aircraft.set_surfaces(self.faults.surfaces(self._acting))
                moved = False
            self._signals = self.aircraft.step()
            self._step += 1
        for angle in ("roll", "pitch"):
            if not abs(self._signals[COLUMN[angle]]) < LARGEST_UPSET:  # NaN fails too
                raise SimulationError(f"the aircraft is lost at {self.time:.1f} s: its {angle}")
        return faults

    @property
    def time(self) -> float:
        """Time of the newest sample, s after the first."""
        return self._step / SIMULATION_RATE

    def sample(self) -> Sample:
        """Measure the aircraft as it is; to be called once for each sample."""
        signals = self.aircraft.to_si(np.array(self._signals))
        rates, force = signals[0:3], signals[6:9]
        gyro, accelerometer = (rng.standard_normal(3) for rng in self._noise)
        return Sample(
            time=self.time,
            rates=rates,
            measured_rates=rates
            + np.asarray(self._sensors.gyro_bias)
            + self._sensors.gyro_noise * gyro,
            measured_force=force + self._sensors.accelerometer_noise * accelerometer,
            attitude=signals[[COLUMN["roll"], COLUMN["pitch"], COLUMN["yaw"]]],
            surfaces=signals[
                [COLUMN[name] for name in ("elevator", "rudder", "aileron")] + [COLUMN["throttle"]]
            ],
        )


def whole(value: float, what: str) -> int:
    """Return a number of simulation steps as an integer.

    Raises
    ------
    SimulationError
        If it is none; the message names `what`.
    """
    if not (value >= 0.0 and abs(value - round(value)) < 1e-6):
        raise SimulationError(
            f"{what} is no whole number of simulation steps of {1e3 / SIMULATION_RATE:g} ms"
        )
    return round(value)
