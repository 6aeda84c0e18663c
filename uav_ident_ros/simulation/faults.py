# SPDX-License-Identifier: Apache-2.0
"""Faults of an aircraft in the loop, as short commands.

    aileron effect 0.5     half of its effect about trim; 0 is a lost surface, -1 a reversed one
    motor_front_left effect 0.7    factor on the whole thrust of a quadrotor's motor
    elevator jams          the surface stays at its position
    rudder jams -0.05      the surface stays at that deflection from trim, rad
    pitch inertia 1.3      ballast fore and aft (roll: on the wings) for this factor of the inertia
    cg aft 0.1             centre of gravity moves aft by that share of the mean chord
    engine out             the last of several engines, or the only one, fails
    turbulence 4           JSBSim's severity, 0 (calm) to 7
    repaired               all surfaces are intact again; ballast and weather stay

A time in front, ``90.0: aileron effect 0.5``, delays the fault until then.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from uav_ident_ros.files.strict_yaml import comma
from uav_ident_ros.simulation.aircraft import FOOT
from uav_ident_ros.simulation.channels import PLAIN, QUADROTOR
from uav_ident_ros.simulation.flight import SimulationError

SURFACE_NAMES = PLAIN.names
"""Names of the channels, in the order of de, dr, da, dth."""

FORMS = (
    "'SURFACE effect FACTOR', 'SURFACE jams [DEFLECTION]', 'roll|pitch inertia FACTOR', "
    "'cg aft SHARE', 'engine out', 'turbulence SEVERITY', 'repaired'"
)

GRAVITY_FT = 32.174049
"""Weight of a slug, lbf."""

INCHES_PER_FOOT = 12.0

TURBULENCE_TUSTIN = 4
"""JSBSim's MIL-F-8785C turbulence, discretised by Tustin's rule."""

MAX_TURBULENCE = 7
"""Largest probability-of-exceedance index of JSBSim's turbulence."""

WIND_AT_20_FEET = 25.0
"""Low-altitude wind of the turbulence model, ft/s; it has an effect below 2000 ft only."""

BALLAST_AXES = {"roll": ("Y", "inertia/ixx-slugs_ft2"), "pitch": ("X", "inertia/iyy-slugs_ft2")}
"""Axis along which the ballast is placed, and the inertia that it raises."""

BALLAST_ARM = 3.3 / FOOT
"""Distance of each ballast from the centre of gravity, ft: near nose and tail of a light aircraft,
where little mass is needed."""

INERTIA_TOLERANCE = 0.005
"""Largest relative error of the inertia or position that JSBSim then reports."""

CENTRE_BALLAST = 0.05
"""Mass that moves the centre of gravity, relative to the aircraft's."""


@dataclass(frozen=True)
class Fault:
    """One fault."""

    kind: str  # effect, jams, inertia, cg, engine, turbulence or repaired
    what: str = ""  # Surface or axis; empty for kinds without one
    value: float | None = None  # Factor, deflection or severity
    time: float = -math.inf  # Time, s after the first sample; -inf for at once

    def __str__(self) -> str:
        value = "" if self.value is None else f"{self.value:g}"
        return " ".join(filter(None, (self.what, self.kind, value)))


def parse_fault(text: str) -> Fault:
    """Return the fault of a command, with or without a time."""
    before, colon, command = text.rpartition(":")
    words = command.split()
    try:
        time = _within(before, -math.inf, math.inf) if colon else -math.inf
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
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"'{text}' is no number{comma(text)}") from None
    if not low <= value <= high:  # NaN fails too
        raise ValueError(f"{text} is not within {low:g} to {high:g}")
    return value


def add_ballast(fdm: Any, axis: str, factor: float) -> None:
    """Multiply an inertia by `factor`, with equal masses on both sides of the centre of gravity.

    JSBSim computes the inertias and silently ignores a write to them. Loaded point masses change
    them instead, and the result is read back.
    """
    direction, name = BALLAST_AXES[axis]
    wanted = factor * fdm[name]
    weight = (wanted - fdm[name]) / (2.0 * BALLAST_ARM**2) * GRAVITY_FT
    _load(fdm, direction, (BALLAST_ARM, -BALLAST_ARM), weight)
    if abs(fdm[name] - wanted) > INERTIA_TOLERANCE * wanted:
        raise SimulationError(
            f"'{axis} inertia {factor:g}': JSBSim says {fdm[name]:.0f} slug ft^2 where "
            f"{wanted:.0f} are wanted"
        )


def move_centre(fdm: Any, share: float) -> None:
    """Move the centre of gravity aft by a share of the mean chord, with one mass well aft."""
    before, wanted = fdm["inertia/cg-x-in"], share * fdm["metrics/cbarw-ft"]
    weight = CENTRE_BALLAST * fdm["inertia/weight-lbs"]
    _load(fdm, "X", (wanted * (1.0 + CENTRE_BALLAST) / CENTRE_BALLAST,), weight)
    moved = (fdm["inertia/cg-x-in"] - before) / INCHES_PER_FOOT
    if abs(moved - wanted) > INERTIA_TOLERANCE * abs(wanted):
        raise SimulationError(f"'cg aft {share:g}': JSBSim moved it by {moved:.3f} ft")


def _load(fdm: Any, direction: str, offsets: Sequence[float], weight: float) -> None:
    """Load empty point masses with `weight` (lbf) each, at offsets (ft) from the centre."""
    manager, masses, free = fdm.get_property_manager(), 0, []
    while manager.hasNode(f"inertia/pointmass-weight-lbs[{masses}]"):
        places = [f"inertia/pointmass-location-{letter}-inches[{masses}]" for letter in "XYZ"]
        if not any(fdm[name] for name in (f"inertia/pointmass-weight-lbs[{masses}]", *places)):
            free.append((masses, places))
        masses += 1
    if len(free) < len(offsets):
        raise SimulationError("a fault of the mass: all of the aircraft's ballasts are in use")
    for offset, (index, places) in zip(offsets, free, strict=False):
        for letter, place in zip("XYZ", places, strict=True):
            there = offset * INCHES_PER_FOOT if letter == direction else 0.0
            fdm[place] = fdm[f"inertia/cg-{letter.lower()}-in"] + there
        fdm[f"inertia/pointmass-weight-lbs[{index}]"] = weight
    fdm.run()  # the masses take effect with the next step


def start_turbulence(fdm: Any, severity: int, seed: int) -> None:
    """Set turbulence of severity 1 to `MAX_TURBULENCE`; 0 changes nothing."""
    if severity:
        fdm["simulation/randomseed"] = seed
        fdm["atmosphere/randomseed"] = seed
        fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = WIND_AT_20_FEET
        fdm["atmosphere/turbulence/milspec/severity"] = severity
        fdm["atmosphere/turb-type"] = TURBULENCE_TUSTIN
