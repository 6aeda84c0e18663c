# SPDX-License-Identifier: Apache-2.0
"""What can go wrong with an aircraft in the loop, as short commands.

    aileron effect 0.5     half of its effect about trim; 0 is a surface lost, -1 reversed
    motor_front_left effect 0.7    the same of a quadrotor's motor, of its whole thrust
    elevator jams          stands still where it is
    rudder jams -0.05      stands still at that deflection from trim, rad
    pitch inertia 1.3      ballast fore and aft (roll: on the wings), by that factor
    cg aft 0.1             centre of gravity moves aft by that share of the mean chord
    engine out             the last of several engines, or the only one
    turbulence 4           JSBSim's, 0 (calm) to 7
    repaired               every surface as it was; ballast and weather stay

With a time in front, ``90.0: aileron effect 0.5``, it happens then.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.aircraft import FOOT, MAX_TURBULENCE, Aircraft, start_turbulence
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.errors import SimulationError

SURFACE_NAMES = ("elevator", "rudder", "aileron", "throttle")
"""Names of the channels, in the order of de, dr, da, dth."""

FORMS = (
    "'SURFACE effect FACTOR', 'SURFACE jams [DEFLECTION]', 'roll|pitch inertia FACTOR', "
    "'cg aft SHARE', 'engine out', 'turbulence SEVERITY', 'repaired'"
)

GRAVITY_FT = 32.174049
"""Weight of a slug, lbf."""

INCHES_PER_FOOT = 12.0

BALLAST_AXES = {"roll": ("Y", "inertia/ixx-slugs_ft2"), "pitch": ("X", "inertia/iyy-slugs_ft2")}
"""Where the ballast goes and the inertia that it raises."""

BALLAST_ARM = 3.3 / FOOT
"""Distance of each ballast from the centre of gravity, ft: near nose and tail of a light
aircraft, so that its mass hardly changes."""

INERTIA_TOLERANCE = 0.005
"""Largest misfit of what is read back, relative."""

CENTRE_BALLAST = 0.05
"""Mass that moves the centre of gravity, over the aircraft's."""


@dataclass(frozen=True)
class Fault:
    """One fault."""

    kind: str  # ``effect``, ``jams``, ``inertia``, ``turbulence`` or ``repaired``
    what: str = ""  # Surface or axis; empty if it needs none
    value: float | None = None  # Factor, deflection or severity
    time: float = -math.inf  # When, s after the first sample; -inf for at once


def parse_fault(text: str) -> Fault:
    """Read a command, with or without a time.

    Raises
    ------
    SimulationError
        If it is none; the message says what would be.
    """
    before, colon, command = text.rpartition(":")
    words = command.split()
    try:
        time = float(before) if colon else -math.inf
        match words:
            case ["repaired"]:
                return Fault("repaired", time=time)
            case ["turbulence", severity]:
                return Fault("turbulence", value=_within(severity, 0, MAX_TURBULENCE), time=time)
            case ["engine", "out"]:
                return Fault("engine", time=time)
            case ["cg", "aft", share]:
                return Fault("cg", value=_within(share, -0.3, 0.3), time=time)
            case [axis, "inertia", factor] if axis in BALLAST_AXES:
                return Fault("inertia", axis, _within(factor, 1.0, 3.0), time)
            case [surface, "effect", factor] if surface in (*SURFACE_NAMES, *QUADROTOR.names):
                return Fault("effect", surface, _within(factor, -2.0, 2.0), time)
            case [surface, "jams"] if surface in SURFACE_NAMES:
                return Fault("jams", surface, time=time)
            case [surface, "jams", deflection] if surface in SURFACE_NAMES:
                return Fault("jams", surface, _within(deflection, -1.0, 1.0), time)
    except ValueError as error:
        raise SimulationError(f"fault '{text}': {error}") from None
    raise SimulationError(
        f"fault '{text}' is none of {FORMS}; surfaces are {', '.join(SURFACE_NAMES)}"
    )


def _within(text: str, low: float, high: float) -> float:
    value = float(text)
    if not low <= value <= high:  # NaN fails too
        raise ValueError(f"{text} is not within {low:g} to {high:g}")
    return value


class Schedule:
    """Faults that come at a time of their own."""

    def __init__(
        self,
        scheduled: Sequence[Fault],  # What comes, in any order
        apply: Callable[[Fault], None],  # Lets one happen now
    ) -> None:
        self.apply = apply
        self._scheduled = sorted(scheduled, key=lambda fault: fault.time)

    def due(self, time: float) -> list[Fault]:
        """Apply what is scheduled until `time` (s) and return it."""
        found = []
        while self._scheduled and self._scheduled[0].time <= time:
            found.append(self._scheduled.pop(0))
            self.apply(found[-1])
        return found


class Faults:
    """State of an aircraft's faults."""

    def __init__(
        self,
        aircraft: Aircraft,  # Whose mass and weather they change
        trim: FloatArray,  # (4,) Surfaces in trimmed flight: an effect is lost about them
        seed: int,  # Seed of the turbulence
    ) -> None:
        self._aircraft, self._trim, self._seed = aircraft, trim, seed
        self._effect = np.ones(4)
        self._jammed = np.full(4, np.nan)

    def apply(self, fault: Fault) -> None:
        """Let it happen now.

        Raises
        ------
        SimulationError
            If this aircraft cannot have it.
        """
        if fault.what in QUADROTOR.names:
            raise SimulationError(f"fault '{fault.what} effect': this aircraft has surfaces")
        index = SURFACE_NAMES.index(fault.what) if fault.what in SURFACE_NAMES else 0
        match fault.kind:
            case "repaired":
                self._effect[:] = 1.0
                self._jammed[:] = np.nan
            case "effect":
                self._effect[index] = fault.value
            case "jams":
                now = self._aircraft.surfaces[index]
                at = now if fault.value is None else self._trim[index] + fault.value
                self._jammed[index] = at
            case "turbulence":
                start_turbulence(self._aircraft.fdm, round(fault.value or 0.0), self._seed)
            case "engine":
                self._aircraft.stop_engine()
            case "cg":
                move_centre(self._aircraft.fdm, fault.value or 0.0)
            case "inertia":
                add_ballast(self._aircraft.fdm, fault.what, fault.value or 1.0)

    def surfaces(self, commanded: FloatArray) -> FloatArray:
        """Return what the surfaces do when `commanded`, shape (4,)."""
        moved = self._trim + self._effect * (commanded - self._trim)
        return np.where(np.isnan(self._jammed), moved, self._jammed)


def add_ballast(fdm: Any, axis: str, factor: float) -> None:
    """Multiply an inertia by `factor`, with equal masses on both sides of the centre of gravity.

    JSBSim computes the inertias itself and silently ignores a write to them; so empty point
    masses are loaded, and what they did is read back.

    Raises
    ------
    SimulationError
        If all ballasts are in use, or the inertia is not what it should be.
    """
    direction, name = BALLAST_AXES[axis]
    wanted = factor * fdm[name]
    weight = (wanted - fdm[name]) / (2.0 * BALLAST_ARM**2) * GRAVITY_FT
    pair = [_place(fdm, direction, side * BALLAST_ARM) for side in (1.0, -1.0)]
    for index in pair:
        fdm[f"inertia/pointmass-weight-lbs[{index}]"] = weight
    fdm.run()  # the masses count from the next step on
    if abs(fdm[name] - wanted) > INERTIA_TOLERANCE * wanted:
        raise SimulationError(
            f"'{axis} inertia {factor:g}': JSBSim says {fdm[name]:.0f} slug ft^2 where "
            f"{wanted:.0f} are wanted"
        )


def move_centre(fdm: Any, share: float) -> None:
    """Move the centre of gravity aft by a share of the mean chord, with one mass well aft.

    Raises
    ------
    SimulationError
        If JSBSim's own centre of gravity is not where it should be.
    """
    before, wanted = fdm["inertia/cg-x-in"], share * fdm["metrics/cbarw-ft"]
    weight = CENTRE_BALLAST * fdm["inertia/weight-lbs"]
    index = _place(fdm, "X", wanted * (1.0 + CENTRE_BALLAST) / CENTRE_BALLAST)
    fdm[f"inertia/pointmass-weight-lbs[{index}]"] = weight
    fdm.run()
    moved = (fdm["inertia/cg-x-in"] - before) / INCHES_PER_FOOT
    if abs(moved - wanted) > INERTIA_TOLERANCE * abs(wanted):
        raise SimulationError(f"'cg aft {share:g}': JSBSim moved it by {moved:.3f} ft")


def _place(fdm: Any, direction: str, offset: float) -> int:
    """Put an empty point mass `offset` ft from the centre of gravity; return its index."""
    manager, index = fdm.get_property_manager(), 0
    while manager.hasNode(f"inertia/pointmass-weight-lbs[{index}]"):
        places = [f"inertia/pointmass-location-{letter}-inches[{index}]" for letter in "XYZ"]
        weight = fdm[f"inertia/pointmass-weight-lbs[{index}]"]
        if weight == 0.0 and not any(fdm[place] for place in places):
            for letter, place in zip("XYZ", places, strict=True):
                there = offset * INCHES_PER_FOOT if letter == direction else 0.0
                fdm[place] = fdm[f"inertia/cg-{letter.lower()}-in"] + there
            return index
        index += 1
    raise SimulationError("a fault of the mass: all of the aircraft's ballasts are in use")
