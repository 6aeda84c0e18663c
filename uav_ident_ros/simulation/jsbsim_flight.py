# SPDX-License-Identifier: Apache-2.0
"""Flights of JSBSim's nonlinear aircraft."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.aircraft import PROPERTIES, Aircraft, cruise_derivatives, settle
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.faults import (
    MAX_TURBULENCE,
    SURFACE_NAMES,
    Fault,
    add_ballast,
    move_centre,
    start_turbulence,
)
from uav_ident_ros.simulation.flight import Flight, SimulationError
from uav_ident_ros.simulation.live import SIMULATION_RATE, Live, Plan
from uav_ident_ros.simulation.noise import Sensors

SPEED_GAIN = 0.05
"""Throttle per m/s of speed error: slow, but sufficient for climbs of a few degrees."""

BANK_TIME = 20.0
"""Time of each turn of a banked flight, s, its `ROLL_TIME` included."""

ROLL_TIME = 4.0
"""Time in which the reference of the bank angle changes, s."""

MAX_BANK = 60.0
"""Largest reference of the bank angle, deg."""


class LiveAircraft(Live):
    """A JSBSim aircraft in flight; a recorded row has the signals of the step."""

    names = SURFACE_NAMES

    def __init__(
        self,
        name: str,  # As in `uav_ident_ros.simulation.airframe`
        sensors: Sensors,  # sensors, delay, faults, seed, rate: As in `Live`
        delay: float = 0.0,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        speed: float | None = None,  # True airspeed in place of the airframe's, m/s
        rate: float = SIMULATION_RATE,
        time_constant: float = 0.0,  # First-order lag of the surfaces without the throttle, s
    ) -> None:
        super().__init__(sensors, delay, seed, rate, faults)
        self.aircraft = Aircraft(name, rate, speed)  # JSBSim's aircraft
        self.autopilot, self.signals = settle(self.aircraft, sensors.rate)
        self.trim = self.outputs = self._acting = self.aircraft.surfaces
        self._wanted = self.signals["airspeed"]
        self._seed, self._effect, self._jammed = seed, np.ones(4), np.full(4, np.nan)
        self._lagged = self._acting
        keep = np.exp(-1.0 / (rate * time_constant)) if time_constant else 0.0
        self._keep = keep * np.array([1.0, 1.0, 1.0, 0.0])

    def check(self, fault: Fault) -> None:
        """Refuse a fault of a motor; see `Live.check`."""
        if fault.what in QUADROTOR.names:
            raise SimulationError(f"fault '{fault}': this aircraft has surfaces")

    def _apply(self, fault: Fault) -> None:
        index = SURFACE_NAMES.index(fault.what) if fault.what in SURFACE_NAMES else 0
        match fault.kind:
            case "repaired":
                self._effect[:] = 1.0
                self._jammed[:] = np.nan
            case "effect":
                self._effect[index] = fault.value
            case "jams":
                now = self.aircraft.surfaces[index]
                at = now if fault.value is None else self.trim[index] + fault.value
                self._jammed[index] = at
            case "turbulence":
                start_turbulence(self.aircraft.fdm, round(fault.value or 0.0), self._seed)
            case "engine":
                self.aircraft.stop_engine()
            case "cg":
                move_centre(self.aircraft.fdm, fault.value or 0.0)
            case "inertia":
                add_ballast(self.aircraft.fdm, fault.what, fault.value or 1.0)

    def _answer(self, surfaces: FloatArray | None) -> FloatArray:
        slow = self._wanted - self.signals["airspeed"]
        commanded = self.outputs[:3] if surfaces is None else surfaces
        return self.aircraft.clip(np.append(commanded, self.trim[3] + SPEED_GAIN * slow))

    def _fly(self, acting: FloatArray, moved: bool) -> tuple[float, ...]:
        if self._keep.any():
            before = self._lagged if self._step else acting
            acting = self._lagged = acting + self._keep * (before - acting)
            moved = True
        if moved:
            moved_to = self.trim + self._effect * (acting - self.trim)
            self.aircraft.set_surfaces(np.where(np.isnan(self._jammed), moved_to, self._jammed))
        self.signals = self.aircraft.step()
        return (*self.signals.values(),)

    def _picked(self, *names: str) -> FloatArray:
        return np.array([self.signals[name] for name in names])

    def _attitude(self) -> Sequence[float]:
        return [self.signals[name] for name in ("roll", "pitch", "yaw")]

    def _state(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        rates, force = self._picked("p", "q", "r"), self._picked("fx", "fy", "fz")
        return rates, force, self._picked(*self.names), self.signals["airspeed"]


@dataclass(frozen=True, kw_only=True)
class AircraftFlight(Plan):
    """Flight of a JSBSim aircraft on a simple autopilot."""

    aircraft: str  # Its name, or the path of its file: see `uav_ident_ros.simulation.airframe`
    bank: float = 0.0  # Bank angle of alternating turns, deg; 0 for level flight
    turbulence: int = 0  # JSBSim's MIL-F-8785C severity, 0 (calm) to 7
    faults: Sequence[Fault] = ()  # With their times
    speed: float | None = None  # True airspeed, m/s; None for the airframe's

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.turbulence <= MAX_TURBULENCE:
            raise SimulationError(
                f"turbulence is {self.turbulence}: it must be 0 (calm) to {MAX_TURBULENCE}"
            )
        if not abs(self.bank) <= MAX_BANK:
            raise SimulationError(f"bank is {self.bank} deg: at most {MAX_BANK:g} is flown")

    def _bank_reference(self, t: float) -> float:
        """Return the bank angle at a time, rad: alternating turns, the first to the right."""
        if self.bank == 0.0 or t < 0.0:
            return 0.0
        turn, into = divmod(t, BANK_TIME)
        side = 1.0 if turn % 2 == 0 else -1.0
        last = 0.0 if turn == 0 else -side
        blend = min(1.0, into / ROLL_TIME)
        return math.radians(self.bank) * (last + (side - last) * blend)

    def fly(self, name: str = "") -> Flight:
        """Fly it; see `Plan.fly`."""
        faults = [Fault("turbulence", value=self.turbulence, time=0.0), *self.faults]
        sensors = Sensors(rate=self.actuator_rate)
        live = LiveAircraft(
            self.aircraft, sensors, self.delay, faults, self.seed, self.speed, self.rate,
            self.time_constant,
        )  # fmt: skip

        def commanded(t: float, excitation: FloatArray) -> FloatArray:
            wanted = live.autopilot.surfaces(live.signals, self._bank_reference(t))
            return live.aircraft.clip(wanted + excitation)

        rows, commands, common = live.record(self, commanded)
        signals = dict(zip(PROPERTIES, rows.T, strict=True))
        extra = {key: signals[key] for key in ("alpha", "beta", "roll", "pitch", "altitude")}
        extra["surfaces"] = np.column_stack([signals[key] for key in SURFACE_NAMES])
        airspeed = signals["airspeed"]
        return Flight(
            name=name or live.aircraft.airframe.name,
            specific_force=rows[:, 6:9],
            inputs=commands - live.trim,
            trim=np.array(live.trim),
            # Excitation at trim throttle slows the aircraft: 1 % of airspeed is 2 % of pdot/da.
            local_truth=cruise_derivatives(self.aircraft, round(float(airspeed.mean()), 1)),
            airspeed=airspeed,
            extra=extra,
            **common,
        )
