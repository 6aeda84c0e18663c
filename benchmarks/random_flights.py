# SPDX-License-Identifier: Apache-2.0
"""Flights of aircraft drawn at random, none of which served for tuning.

Random are airspeed, natural frequencies and derivatives of the aircraft; rate, noise and position
of its Imu; delay and lag, and whether they are configured correctly; the reference airspeed; gusts
and turns; kind, amplitude and duration of the excitation; size and time of a surface's loss.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from light_aircraft import SPEED, TRUTH, LightFlight

from uav_ident_ros.simulation.flight import CoefficientChange
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure

DURATION = 110.0
"""Length of a flight, s."""

SPREAD: Mapping[str, tuple[float, float]] = {
    "pdot/p": (0.6, 1.8), "pdot/r": (0.2, 1.5), "pdot/beta": (0.1, 2.0), "pdot/dr": (-0.3, 2.0),
    "pdot/da": (0.5, 2.5),
    "qdot/q": (0.4, 1.7), "qdot/alpha": (0.2, 2.2), "qdot/de": (0.4, 2.0),
    "rdot/p": (-0.5, 2.5), "rdot/r": (0.3, 2.0), "rdot/beta": (0.3, 2.2), "rdot/dr": (0.3, 2.0),
    "rdot/da": (-1.0, 3.0),
    "ay/beta": (0.4, 1.7), "ay/dr": (0.2, 1.6), "az/alpha": (0.25, 1.2), "az/de": (0.2, 2.0),
}  # fmt: skip
"""Range of each derivative, relative to that of the light aircraft."""


@dataclass(frozen=True)
class Draw:
    """One aircraft, its sensors, its settings and its flight."""

    flight: LightFlight
    sensors: Sensors
    settings: Mapping[str, Any]  # Besides those for the topics
    excited: bool
    label: str


class Chance:
    """Random numbers of one draw."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 99])

    def between(self, low: float, high: float) -> float:
        """Return a number of a range."""
        return float(self._rng.uniform(low, high))

    def octaves(self, low: float, high: float) -> float:
        """Return a number of a range with a uniform logarithm."""
        return math.exp(self.between(math.log(low), math.log(high)))

    def one_of(self, *values: Any) -> Any:
        """Return one of some values."""
        return values[int(self._rng.integers(len(values)))]


def draw(seed: int) -> Draw:
    """Draw aircraft, sensors, settings and flight for a seed."""
    chance = Chance(seed)
    between, octaves, one_of = chance.between, chance.octaves, chance.one_of
    speed, quick = octaves(11.0, 60.0), octaves(0.35, 1.6)
    derivatives = _derivatives(speed, quick, {k: between(*v) for k, v in SPREAD.items()})
    how = one_of("multisine", "multisine", "3211", "doublet", "", "until 40 s", "until 40 s")
    scale, peaks = octaves(0.25, 1.6), _peaks(derivatives)
    segment = Segment(
        how if how in ("3211", "doublet") else "multisine", 2.0,
        38.0 if how == "until 40 s" else DURATION,
        {name: scale * peak for name, peak in peaks.items()}, seed=seed,
    )  # fmt: skip
    surface, left = one_of(("de", 0.3), ("de", 0.5), ("da", 0.5), ("da", 0.7), ("dr", -1.0),
                           ("dr", 0.0), ("dr", 0.5))  # fmt: skip
    fails = one_of(False, False, True)
    delay, lag = one_of(0.0, 0.02, 0.05, 0.1), one_of(0.0, 0.0, 0.03, 0.06)
    flight = LightFlight(
        [segment] if how else [], DURATION, rate=400.0, actuator_rate=one_of(20.0, 50.0, 100.0),
        delay=delay, seed=seed,
        bank=one_of(0.0, 15.0, 30.0), gust=speed / SPEED * one_of(0.0, 0.3, 0.8),
        time_constant=lag, yaw_damper=0.1, roll_gain=0.2 * min(1.0, 45.0 / derivatives["pdot/da"]),
        roll_gust=min(6.0 / speed, 0.5), speed=speed, derivatives=derivatives,
        changes=(CoefficientChange(between(35.0, 80.0), {surface: left}),) if fails else (),
    )  # fmt: skip
    sensors = _sensors(chance)
    settings = {
        "actuators.delay": max(delay + one_of(0.0, 0.0, 0.015, -0.015), 0.0),
        "actuators.time_constant": lag * one_of(1.0, 1.0, 0.5),
        "actuators.estimate_delay": one_of(False, False, True),
        "airspeed.reference": speed * one_of(1.0, 1.0, 0.8, 1.25),
    }
    label = (
        f"{speed:.0f} m/s, {how or 'not excited'} x {scale:.2f}, Imu {sensors.rate:g} Hz, wind "
        f"{flight.gust:.1f}, delay {1e3 * delay:g} ms, lag {1e3 * lag:g} ms"
        + (f", {surface} x {left:g}" if fails else "")
    )
    return Draw(flight, sensors, settings, bool(how), label)


def _sensors(chance: Chance) -> Sensors:
    between, octaves, one_of = chance.between, chance.octaves, chance.one_of
    return Sensors(
        rate=one_of(25.0, 50.0, 100.0, 200.0, 400.0), gyro_noise=octaves(0.003, 0.05),
        accelerometer_noise=octaves(0.05, 1.2), stamped=one_of(True, True, False),
        lever_arm=one_of((0.0, 0.0, 0.0), (between(-0.3, 0.3), 0.0, between(-0.08, 0.08))),
    )  # fmt: skip


def _derivatives(speed: float, quick: float, factors: Mapping[str, float]) -> dict[str, float]:
    """Return derivatives of an aircraft with natural frequencies `quick` times the light one's.

    Derivatives by rates grow with this factor, those by angles with its square. In level flight
    lift equals weight at any airspeed.
    """
    out = {}
    for name, factor in factors.items():
        row, _, column = name.partition("/")
        size = quick if column in "pqr" else quick * quick
        if row == "ay":
            size = speed / SPEED
        elif row == "az":
            size = 1.0
        out[name] = factor * size * TRUTH[name]
    return out


def _peaks(derivatives: Mapping[str, float]) -> dict[str, float]:
    """Return peak deflections, rad, with angular accelerations like those by a pilot."""
    roll = 0.5 * abs(derivatives["pdot/p"] / derivatives["pdot/da"])
    pitch = 0.09 * max(-derivatives["qdot/alpha"], 9.0) / -derivatives["qdot/de"]
    yaw = 0.15 * derivatives["rdot/beta"] / -derivatives["rdot/dr"]
    return {"de": min(pitch, 0.3), "dr": min(yaw, 0.35), "da": min(roll, 0.35), "dth": 0.1}


def fly(seed: int) -> Measurements:
    """Fly the drawn flight; its truth holds at the mean airspeed flown."""
    drawn = draw(seed)
    flight = drawn.flight.fly()
    assert flight.airspeed is not None
    ratio = float(flight.airspeed.mean()) / drawn.flight.speed
    truth = {
        name: value * (ratio if name.partition("/")[2] in "pqr" else ratio * ratio)
        for name, value in flight.local_truth.items()
    }
    return measure(replace(flight, local_truth=truth), drawn.sensors, seed)
