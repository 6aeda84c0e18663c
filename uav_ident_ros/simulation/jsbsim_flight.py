# SPDX-License-Identifier: Apache-2.0
"""Flights of JSBSim aircraft: nonlinear aircraft that nobody here modelled."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.aircraft import COLUMN, MAX_TURBULENCE
from uav_ident_ros.simulation.airframe import airframe
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.faults import SURFACE_NAMES, Fault
from uav_ident_ros.simulation.flight import (
    CoefficientChange,
    Flight,
    check_positive,
    effect_of,
)
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.linearisation import cruise_derivatives
from uav_ident_ros.simulation.live import LiveAircraft
from uav_ident_ros.simulation.noise import Sensors

BANK_TIME = 20.0
"""Time of each turn of a banked flight, s, rolled into over `ROLL_TIME`."""

ROLL_TIME = 4.0
"""Time in which the reference of the bank angle changes, s."""

MAX_BANK = 60.0
"""Largest bank angle that the autopilot is asked for, deg."""


@dataclass(frozen=True)
class AircraftFlight:
    """Everything that defines a flight of a JSBSim aircraft."""

    aircraft: str  # Its name, or the path of its file: see `uav_ident_ros.simulation.airframe`
    segments: Sequence[Segment]  # Excitation, added to the autopilot's commands
    duration: float  # Length of the record, s
    rate: float = 1000.0  # Rate of the simulation and of the noise-free samples, Hz
    actuator_rate: float = 100.0  # Rate of the commands, Hz; each is held until the next
    delay: float = 0.0  # From recorded command to surface, s
    bank: float = 0.0  # Bank angle of alternating turns, deg; 0 for level flight
    turbulence: int = 0  # JSBSim's MIL-F-8785C severity, 0 (calm) to 7
    # From a time on, an input (``de`` and so on) has its effect about trim multiplied
    changes: tuple[CoefficientChange, ...] = ()
    seed: int = 0  # Seed of the turbulence
    speed: float | None = None  # True airspeed, m/s; None for the aircraft's own

    def __post_init__(self) -> None:
        airframe(self.aircraft, self.speed)
        check_positive(self, "duration", "rate", "actuator_rate")
        if not 0.0 <= self.delay < math.inf:
            raise SimulationError(f"delay is {self.delay} s: it must be 0 or more")
        if not 0 <= self.turbulence <= MAX_TURBULENCE:
            raise SimulationError(
                f"turbulence is {self.turbulence}: it must be 0 (calm) to {MAX_TURBULENCE}"
            )
        if not abs(self.bank) <= MAX_BANK:
            raise SimulationError(f"bank is {self.bank} deg: at most {MAX_BANK:g} is flown")
        for change in self.changes:
            for name in change.factors:
                if name not in INPUTS:
                    raise SimulationError(
                        f"change of '{name}': an aircraft changes the effect of an input, "
                        f"one of {', '.join(INPUTS)}"
                    )


def _bank_reference(spec: AircraftFlight, t: float) -> float:
    """Bank angle of alternating turns, rad: right, left, right, ..."""
    if spec.bank == 0.0 or t < 0.0:
        return 0.0
    turn, into = divmod(t, BANK_TIME)
    side = 1.0 if turn % 2 == 0 else -1.0
    last = 0.0 if turn == 0 else -side
    blend = min(1.0, into / ROLL_TIME)
    return math.radians(spec.bank) * (last + (side - last) * blend)


def fly(
    spec: AircraftFlight,  # The flight
    name: str = "",  # Name of the result; the aircraft's by default
) -> Flight:
    """Fly a JSBSim aircraft on a simple autopilot.

    Raises
    ------
    SimulationError
        If JSBSim is not installed, or the aircraft cannot be trimmed or is lost.
    """
    faults = [Fault("turbulence", value=spec.turbulence, time=0.0)]
    for change in spec.changes:
        effect = effect_of(spec.changes, change.time)
        faults += [
            Fault("effect", SURFACE_NAMES[i], effect[i], change.time)
            for i in map(INPUTS.index, change.factors)
        ]
    live = LiveAircraft(
        spec.aircraft, Sensors(rate=spec.actuator_rate), spec.delay, faults, spec.seed,
        spec.speed, spec.rate,
    )  # fmt: skip

    def told(t: float, excitation: FloatArray) -> FloatArray:
        wanted = live.autopilot.surfaces(live.signals, _bank_reference(spec, t))
        return live.aircraft.clip(wanted + excitation)

    flown = live.record(spec.segments, spec.duration, told)
    record = live.aircraft.to_si(flown.rows)
    extra = {key: record[:, COLUMN[key]] for key in ("alpha", "beta", "roll", "pitch", "altitude")}
    surfaces = [COLUMN[key] for key in SURFACE_NAMES]
    airspeed = record[:, COLUMN["airspeed"]]
    return Flight(
        name=name or airframe(spec.aircraft).name,
        rates=record[:, 0:3],
        angular_acceleration=record[:, 3:6],
        specific_force=record[:, 6:9],
        inputs=flown.commands - live.trim,
        trim=np.array(live.trim),
        delay=spec.delay,
        changes=spec.changes,
        # Who excites at trim throttle slows down: a percent of airspeed is two of an aileron.
        local_truth=cruise_derivatives(spec.aircraft, round(float(airspeed.mean()), 1)),
        airspeed=airspeed,
        extra={**extra, "surfaces": record[:, surfaces]},
        **flown.common,
    )
