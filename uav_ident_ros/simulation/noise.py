# SPDX-License-Identifier: Apache-2.0
"""Sensor model of a simulated flight: noise, bias, jitter, drops, frames and stamps."""

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import repeat
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ACTUATORS, AIRSPEED, ARMED, NS_PER_S, RATES_STREAM
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import FLU_TO_FRD
from uav_ident_ros.simulation.flight import (
    Flight,
    IntArray,
    SimulationError,
    check_positive,
    whole_steps,
)

AIRSPEED_RATE = 10.0
"""Rate of a measured airspeed, Hz: about that of PX4 and MAVROS."""


def airspeed_step(rate: float) -> int:
    """Return the number of samples at a rate, Hz, in a period of the airspeed."""
    return max(1, round(rate / AIRSPEED_RATE))


@dataclass(frozen=True)
class Sensors:
    """Sensors, and how their messages are stamped and delivered."""

    rate: float = 200.0  # Rate of the Imu, Hz; a whole fraction of the flight's
    gyro_noise: float = 0.0  # White noise of each gyro sample, rms, rad/s
    # (3,) Constant error of the rates, rad/s, FRD
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accelerometer_noise: float = 0.0  # White noise of each specific-force sample, rms, m/s^2
    # White noise of each sample of the airspeed, rms, m/s; None without a sensor
    airspeed_noise: float | None = None
    airspeed_bias: float = 0.0  # Its constant error, m/s
    # (3,) Position of the accelerometer from the centre of gravity, FRD, m
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stamp_jitter: float = 0.0  # Largest error of the Imu's stamps, uniformly distributed, s
    drop: float = 0.0  # Fraction of Imu samples that are dropped at random
    convention: str = "flu"  # ``flu`` or ``frd``: axes of the Imu message
    # Mean of log time minus true sampling time, s; a shifted exponential distribution that starts
    # at half of the mean
    latency: float = 0.0
    # Whether actuator messages carry a stamp (JointState) or not (Float64MultiArray)
    stamped: bool = True

    def __post_init__(self) -> None:
        check_positive(self, "rate")
        names = ("gyro_noise", "accelerometer_noise", "airspeed_noise", "stamp_jitter", "latency")
        check_positive(self, *names, or_zero=True)
        for name in ("gyro_bias", "airspeed_bias", "lever_arm"):
            if not np.isfinite(getattr(self, name)).all():
                raise SimulationError(f"{name} is {getattr(self, name)}: finite numbers are needed")
        if not 0.0 <= self.drop < 1.0:
            raise SimulationError(f"drop is {self.drop}: it must be 0 or more and below 1")

    @cached_property
    def covariances(self) -> tuple[FloatArray, FloatArray]:
        """Return the covariances of angular velocity and specific force by rows, (9,) each."""
        gyro, accelerometer = (
            np.diag([noise**2] * 3).ravel() for noise in (self.gyro_noise, self.accelerometer_noise)
        )
        return gyro, accelerometer


class SentSample(NamedTuple):
    """A sample on its way to an identifier."""

    arrival_ns: int  # Time of arrival, ns
    stream: str  # Name of the stream in the identifier
    t_ns: int  # Its stamp, ns
    values: tuple[float, ...]  # Rates and specific force; raw channels; the airspeed

    def give(self, identifier: OnlineIdentifier) -> None:
        """Add the sample to an identifier."""
        if self.stream == RATES_STREAM:
            identifier.add_rates(self.t_ns, self.values[:3], self.values[3:] or None)
            return
        add = getattr(identifier, f"add_{self.stream}")
        single = self.stream in (AIRSPEED, ARMED)
        add(self.t_ns, self.values[0] if single else self.values)


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Received samples of a flight, as plain arrays, each stream in the order of arrival."""

    # imu_t_ns, imu_log_ns: (N,) Stamps and log times of the Imu messages, ns
    imu_t_ns: IntArray
    imu_log_ns: IntArray
    # rates, specific_force: (N, 3) In the Imu's axes, rad/s and m/s^2
    rates: FloatArray
    specific_force: FloatArray
    # actuator_t_ns, actuator_log_ns: (M,) The same of the actuator messages, ns; the arrival is
    # the stamp of an unstamped message
    actuator_t_ns: IntArray
    actuator_log_ns: IntArray
    actuators: FloatArray  # (M, C) Raw channels
    # (K,) Stamps and log times of the airspeeds, ns, and their values, m/s; K = 0 without a sensor
    airspeed_t_ns: IntArray
    airspeed_log_ns: IntArray
    airspeed: FloatArray

    def messages(self) -> Iterator[SentSample]:
        """Yield all samples in the order of arrival; at equal times the command is first."""
        inertial = np.hstack([self.rates, self.specific_force])
        columns = (
            (ACTUATORS, self.actuator_log_ns, self.actuator_t_ns, self.actuators),
            (RATES_STREAM, self.imu_log_ns, self.imu_t_ns, inertial),
            (AIRSPEED, self.airspeed_log_ns, self.airspeed_t_ns, self.airspeed[:, None]),
        )
        streams = (
            map(SentSample, log.tolist(), repeat(name), t.tolist(), map(tuple, values.tolist()))
            for name, log, t, values in columns
        )
        return heapq.merge(*streams, key=itemgetter(0))


def fed(identifier: OnlineIdentifier, messages: Iterable[SentSample]) -> Iterator[Estimate]:
    """Add messages to an identifier; yield the estimate of each tick as soon as it is due."""
    for message in messages:
        message.give(identifier)
        yield from identifier.advance()


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurements(Samples):
    """Messages of a simulated flight; `sensors.convention` gives the axes of the Imu."""

    flight: Flight  # The noise-free record
    sensors: Sensors  # The sensors
    true_t_ns: IntArray  # (N,) True sampling times of the Imu messages, ns

    @property
    def true_rates(self) -> FloatArray:
        """Noise-free p, q, r (FRD, rad/s) at the true times of the Imu samples."""
        return self.flight.rates[np.searchsorted(self.flight.t_ns, self.true_t_ns)]


def measure(
    flight: Flight,  # The noise-free record
    sensors: Sensors | None = None,  # The sensors; perfect ones at 200 Hz by default
    # Seed of all randomness. Each error has its own random stream, drawn at the flight's rate: a
    # further error or another Imu rate does not change the others
    seed: int = 0,
) -> Measurements:
    """Return the messages of a flight's sensors."""
    sensors = sensors or Sensors()
    every = whole_steps(1.0 / sensors.rate, flight.rate, f"Imu rate {sensors.rate:g} Hz")
    gyro, accelerometer, drops, jitter, delays, pitot = (
        np.random.default_rng([seed, 100 + k]) for k in range(6)
    )
    count = len(flight.t_ns)
    rates = flight.rates + np.asarray(sensors.gyro_bias)
    rates = rates + sensors.gyro_noise * gyro.standard_normal((count, 3))
    force = flight.force_at(sensors.lever_arm)
    force = force + sensors.accelerometer_noise * accelerometer.standard_normal((count, 3))

    keep = np.arange(0, count, every)
    keep = keep[drops.random(len(keep)) >= sensors.drop]
    offset = sensors.stamp_jitter * jitter.uniform(-1.0, 1.0, count)
    true_t_ns = flight.t_ns[keep]
    axes = FLU_TO_FRD if sensors.convention == "flu" else 1.0
    airspeed, noise = flight.airspeed, sensors.airspeed_noise
    if airspeed is None or noise is None:
        airspeed, noise = np.empty(0), 0.0
    samples = slice(None, None, airspeed_step(flight.rate))
    airspeed = airspeed[samples] + sensors.airspeed_bias
    airspeed_t_ns = flight.t_ns[samples][: len(airspeed)]
    imu_log_ns = _log_times(true_t_ns, sensors.latency, delays)
    actuator_log_ns = _log_times(flight.actuator_t_ns, sensors.latency, delays)
    return Measurements(
        flight=flight,
        sensors=sensors,
        imu_t_ns=true_t_ns + np.rint(offset[keep] * NS_PER_S).astype(np.int64),
        imu_log_ns=imu_log_ns,
        true_t_ns=true_t_ns,
        rates=rates[keep] * axes,
        specific_force=force[keep] * axes,
        actuator_t_ns=flight.actuator_t_ns if sensors.stamped else actuator_log_ns,
        actuator_log_ns=actuator_log_ns,
        actuators=flight.channel_set.raw(flight.inputs, flight.trim),
        airspeed_t_ns=airspeed_t_ns,
        airspeed_log_ns=_log_times(airspeed_t_ns, sensors.latency, delays),
        airspeed=airspeed + noise * pitot.standard_normal(len(airspeed)),
    )


def _log_times(t_ns: IntArray, latency: float, rng: np.random.Generator) -> IntArray:
    """Return arrival times, in order as on one topic of one publisher."""
    if latency == 0.0:
        return t_ns.copy()
    wait = 0.5 * latency * (1.0 + rng.exponential(1.0, len(t_ns)))
    return np.maximum.accumulate(t_ns + np.rint(wait * NS_PER_S).astype(np.int64))
