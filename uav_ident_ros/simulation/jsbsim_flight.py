# SPDX-License-Identifier: Apache-2.0
"""Flights of JSBSim aircraft: nonlinear aircraft that nobody here modelled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.aircraft import (
    COLUMN,
    FOOT,
    MAX_TURBULENCE,
    Aircraft,
    Autopilot,
    start_turbulence,
)
from uav_ident_ros.simulation.airframe import airframe
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.flight import (
    STEP_TOLERANCE,
    CoefficientChange,
    Flight,
    IntArray,
    effect_of,
    stamps,
    whole_steps,
)
from uav_ident_ros.simulation.inputs import Segment, excited_intervals, sample_inputs
from uav_ident_ros.simulation.linearisation import cruise_derivatives

SETTLING_TIME = 20.0
"""Time on the autopilot before the record begins, s."""

BANK_TIME = 20.0
"""Time of each turn of a banked flight, s, rolled into over `ROLL_TIME`."""

ROLL_TIME = 4.0
"""Time in which the reference of the bank angle changes, s."""

MAX_BANK = 60.0
"""Largest bank angle that the autopilot is asked for, deg."""

LARGEST_UPSET = math.radians(80.0)
"""Roll or pitch angle at which a flight counts as lost, rad."""


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
        for name in ("duration", "rate", "actuator_rate"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise SimulationError(f"{name} is {getattr(self, name)}: it must be positive")
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
    aircraft = Aircraft(spec.aircraft, spec.rate, spec.speed)
    interval, named = 1.0 / spec.actuator_rate, f"actuator rate {spec.actuator_rate:g} Hz"
    every = whole_steps(interval, spec.rate, named)
    delay = whole_steps(spec.delay, spec.rate, f"delay {spec.delay:g} s")
    first = -round(SETTLING_TIME * spec.actuator_rate) * every
    last = math.floor(spec.duration * spec.rate + STEP_TOLERANCE)
    steps = np.arange(first, last + 1)
    command_steps = steps[::every]
    excitation = sample_inputs(spec.segments, command_steps / spec.rate)

    signals = aircraft.step()
    autopilot = Autopilot(aircraft.airframe, aircraft.surfaces, signals[COLUMN["pitch"]])
    commands = np.tile(aircraft.surfaces, (len(command_steps), 1))
    trim, record, altitude = aircraft.surfaces, [], signals[COLUMN["altitude"]] * FOOT
    acting, last_effect = -1, effect_of(spec.changes, -math.inf)
    for k, step in enumerate(steps.tolist()):
        t = step / spec.rate
        if step == 0:
            start_turbulence(aircraft.fdm, spec.turbulence, spec.seed)
            trim = commands[max(0, k // every - 1)]
        if k % every == 0:
            above = signals[COLUMN["altitude"]] * FOOT
            climb, altitude = (above - altitude) * spec.actuator_rate, above
            wanted = autopilot.surfaces(signals, climb, _bank_reference(spec, t))
            commands[k // every] = aircraft.clip(wanted + excitation[k // every])
            _check_attitude(spec, signals, t)
        due = max(0, k - delay) // every
        effect = effect_of(spec.changes, t)
        if due != acting or np.any(effect != last_effect):
            acting, last_effect = due, effect
            aircraft.set_surfaces(trim + effect * (commands[due] - trim))
        signals = aircraft.step()
        if step >= 0:
            record.append(signals)
    kept = command_steps >= 0
    return _make_flight(
        spec, name, aircraft.to_si(np.array(record)), command_steps[kept], commands[kept], trim
    )


def _check_attitude(spec: AircraftFlight, signals: Sequence[float], t: float) -> None:
    angles = (signals[COLUMN["roll"]], signals[COLUMN["pitch"]])
    if not all(abs(angle) < LARGEST_UPSET for angle in angles):  # NaN fails too
        raise SimulationError(
            f"JSBSim aircraft '{spec.aircraft}' is lost at {t:.1f} s: use smaller amplitudes, "
            "less bank or less turbulence"
        )


def _make_flight(
    spec: AircraftFlight,
    name: str,
    record: FloatArray,
    command_steps: IntArray,
    commands: FloatArray,
    trim: FloatArray,
) -> Flight:
    extra = {key: record[:, COLUMN[key]] for key in ("alpha", "beta", "roll", "pitch", "altitude")}
    surfaces = [COLUMN[key] for key in ("elevator", "rudder", "aileron", "throttle")]
    return Flight(
        name=name or airframe(spec.aircraft).name,
        t_ns=stamps(np.arange(len(record)) / spec.rate),
        rates=record[:, 0:3],
        angular_acceleration=record[:, 3:6],
        specific_force=record[:, 6:9],
        actuator_t_ns=stamps(command_steps / spec.rate),
        inputs=commands - trim,
        trim=np.array(trim),
        delay=spec.delay,
        changes=spec.changes,
        local_truth=cruise_derivatives(spec.aircraft, spec.speed),
        excitation=excited_intervals(spec.segments, spec.duration),
        airspeed=record[:, COLUMN["airspeed"]],
        extra={**extra, "surfaces": record[:, surfaces]},
    )
