# SPDX-License-Identifier: Apache-2.0
"""A quadrotor that others fly: commands in, Imu samples out, one interval at a time.

The commands are those of an aircraft: elevator, rudder and aileron stand for pitch, yaw and roll.
It mixes them into its motors, and holds its height itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.live_aircraft import RANDOM_STREAM, SIMULATION_RATE, Sample, whole
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.quadrotor import LARGEST_UPSET, Body, Hold, Quadrotor

STILL = (0.0, 0.0, 0.0)


class LiveQuadrotor:
    """A quadrotor in the loop; its attributes are those of `LiveAircraft`.

    Parameters
    ----------
    sensors : Sensors
        Rate of the samples, noise and bias.
    delay : float
        From a sample to the motor that its command reaches, s.
    faults : sequence of Fault
        Those that come at a time of their own.
    seed : int
        Seed of the noise.

    Raises
    ------
    SimulationError
        If a fault is none of a motor's, or a rate or the delay is no whole number of simulation
        steps.
    """

    names = QUADROTOR.names

    def __init__(
        self, sensors: Sensors, delay: float = 0.0, faults: Sequence[Fault] = (), seed: int = 0
    ) -> None:
        self._substeps = whole(SIMULATION_RATE / sensors.rate, f"Imu rate {sensors.rate:g} Hz")
        self._delay = whole(delay * SIMULATION_RATE, f"delay {delay:g} s")
        self._sensors = sensors
        self._noise = [np.random.default_rng([seed, RANDOM_STREAM + k]) for k in range(2)]
        self._step = 0
        self._craft, self._hold = Quadrotor(Body()), Hold()
        self.trim: FloatArray = np.array([0.0, 0.0, 0.0, self._craft.body.hover])
        self._told: FloatArray = self.trim[:3]
        self.outputs: FloatArray = QUADROTOR.trim(self.trim)
        self._acting = self.outputs.tolist()
        self._underway: deque[tuple[int, list[float]]] = deque()
        self.faults = MotorFaults(self._craft, faults)

    def command(self, surfaces: FloatArray | None) -> None:
        """Answer the newest sample.

        Parameters
        ----------
        surfaces : (3,) array or None
            Pitch, yaw, roll, as elevator, rudder, aileron; None: the last answer holds.
        """
        self._told = self._told if surfaces is None else surfaces
        inputs = np.append(self._told, self._hold.inputs(self._craft)[3])
        self.outputs = np.clip(QUADROTOR.raw(inputs, self.trim), 0.0, 1.0)
        self._underway.append((self._step + self._delay, self.outputs.tolist()))

    def advance(self) -> list[Fault]:
        """Fly on to the next sample; return the faults that came at their time.

        Raises
        ------
        SimulationError
            If it is lost.
        """
        faults = self.faults.due(self.time)
        for _ in range(self._substeps):
            while self._underway and self._underway[0][0] <= self._step:
                self._acting = self._underway.popleft()[1]
            self._craft.step(self._acting, 1.0 / SIMULATION_RATE, STILL)
            self._step += 1
        if not max(map(abs, self._craft.angles[:2])) < LARGEST_UPSET:  # NaN fails too
            raise SimulationError(f"the quadrotor is lost at {self.time:.1f} s")
        return faults

    @property
    def time(self) -> float:
        """Time of the newest sample, s after the first."""
        return self._step / SIMULATION_RATE

    def sample(self) -> Sample:
        """Measure it as it is; to be called once for each sample."""
        craft, sensors = self._craft, self._sensors
        craft.look(STILL)
        gyro, accelerometer = (rng.standard_normal(3) for rng in self._noise)
        rates, bias = np.array(craft.rates), np.asarray(sensors.gyro_bias)
        return Sample(
            time=self.time,
            rates=rates,
            measured_rates=rates + bias + sensors.gyro_noise * gyro,
            measured_force=np.array(craft.force) + sensors.accelerometer_noise * accelerometer,
            attitude=np.array(craft.angles),
            surfaces=QUADROTOR.inputs(np.array(craft.speeds), self.trim) + self.trim,
        )


class MotorFaults:
    """State of a quadrotor's faults: what is left of each motor's thrust.

    Parameters
    ----------
    craft : Quadrotor
        Whose motors they are.
    scheduled : sequence of Fault
        Those that come at a time of their own.
    """

    def __init__(self, craft: Quadrotor, scheduled: Sequence[Fault]) -> None:
        self._craft = craft
        self._scheduled = sorted(scheduled, key=lambda fault: fault.time)
        for fault in scheduled:
            _motor(fault)

    def due(self, time: float) -> list[Fault]:
        """Apply what is scheduled until `time` (s) and return it."""
        found = []
        while self._scheduled and self._scheduled[0].time <= time:
            found.append(self._scheduled.pop(0))
            self.apply(found[-1])
        return found

    def apply(self, fault: Fault) -> None:
        """Let it happen now.

        Raises
        ------
        SimulationError
            If it is none of a motor's.
        """
        motor = _motor(fault)
        if motor is None:
            self._craft.effect = [1.0] * len(QUADROTOR.names)
        else:
            self._craft.effect[motor] = fault.value or 0.0


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
