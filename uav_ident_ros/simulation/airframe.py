# SPDX-License-Identifier: Apache-2.0
"""Aircraft as data: one YAML file each, in `airframes/`.

    description: four-seat propeller aircraft, 853 kg
    model: c172p               # JSBSim model: from the wheel, airframes/jsbsim or beside the file
    speed: 53.34               # true airspeed, m/s
    altitude: 914.4            # above sea level, m
    autopilot: {roll_gain: 0.1, pitch_gain: 0.15}
    excitation: {de: 0.08, dr: 0.18, da: 0.1, dth: 0.1}

Further aircraft are further files. A path is accepted in place of a name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from uav_ident_ros.files.strict_yaml import (
    UNUSABLE,
    EntryError,
    TypedLoader,
    finite,
    mapping,
    problem,
)
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.simulation.flight import SimulationError

FOLDER = Path(__file__).parent / "airframes"
MODELS = FOLDER / "jsbsim"
"""Folder of the JSBSim models in this package."""

SUFFIX = ".yaml"


@dataclass(frozen=True)
class AutopilotGains:
    """Gains of the simple autopilot, `uav_ident_ros.simulation.aircraft.Autopilot`."""

    # roll_gain, pitch_gain: Aileron per rad of roll error, elevator per rad of pitch error
    roll_gain: float
    pitch_gain: float
    pitch_damping: float = 0.0  # Elevator per rad/s of pitch rate
    # altitude_gain, climb_gain: Pitch reference per m of altitude error and per m/s of climb, rad
    altitude_gain: float = 1e-3
    climb_gain: float = 5e-3
    speed_gain: float = 0.02  # Throttle per m/s of speed error


@dataclass(frozen=True)
class Airframe:
    """A JSBSim aircraft with its flight condition, autopilot and excitation."""

    name: str  # Name of its file, without the ending
    description: str  # Kind of aircraft, for people
    model: str  # Path of the JSBSim model's folder, or its name if it comes with JSBSim
    speed: float  # True airspeed, m/s
    altitude: float  # Above sea level, m
    autopilot: AutopilotGains  # Tuned for that speed
    # Peaks of the multisines for identification, by input: rad, throttle 0..1
    excitation: Mapping[str, float] = field(default_factory=dict)

    def at_speed(self, speed: float) -> Airframe:
        """Return the airframe at another true airspeed, m/s.

        Surface effectiveness grows with its square: their gains and peaks are scaled inversely.
        """
        if not 0.0 < speed < math.inf:
            raise SimulationError(f"speed is {speed}: it must be positive, m/s")
        factor = (self.speed / speed) ** 2
        of_surfaces = ("roll_gain", "pitch_gain", "pitch_damping")
        gains = {name: factor * getattr(self.autopilot, name) for name in of_surfaces}
        peaks = {k: peak if k == "dth" else factor * peak for k, peak in self.excitation.items()}
        autopilot = replace(self.autopilot, **gains)
        return replace(self, speed=float(speed), autopilot=autopilot, excitation=peaks)


def airframe_names() -> tuple[str, ...]:
    """Return the names of the aircraft in this package."""
    return tuple(sorted((path.stem for path in FOLDER.glob(f"*{SUFFIX}")), key=str.lower))


def airframe(
    name: str,  # One of `airframe_names`, or a path that ends in ``.yaml``
    speed: float | None = None,  # True airspeed in place of the file's, m/s
) -> Airframe:
    """Return an aircraft by name, or by the path of its file."""
    path = Path(name) if name.endswith(SUFFIX) else FOLDER / f"{name}{SUFFIX}"
    if not name.endswith(SUFFIX) and name not in airframe_names():
        raise SimulationError(
            f"aircraft '{name}' is not set up here: use one of {', '.join(airframe_names())}, or "
            "the path of a file like theirs (NAME.yaml)"
        )
    found = _read(path)
    return found if speed is None else found.at_speed(speed)


def _read(path: Path) -> Airframe:
    where = f"aircraft file '{path}'"
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), TypedLoader)
        if not isinstance(content, dict):
            raise EntryError("there are no entries like 'model: c172p'")
        found: Airframe = build(Airframe, {"name": path.stem, **content}, where)
        gains: AutopilotGains = build(AutopilotGains, found.autopilot, f"{where}, autopilot")
        if not isinstance(found.model, str):
            raise EntryError(f"model is the number {found.model}: write it in quotes")
        peaks = mapping(found.excitation, "excitation", (), INPUTS)
        for key, value in {**vars(gains), **peaks}.items():
            finite(value, key)
        for key in ("speed", "altitude"):
            value = getattr(found, key)
            if not (isinstance(value, int | float) and value > 0.0):
                raise EntryError(f"{key} is {value}, not positive")
    except UNUSABLE as error:
        raise SimulationError(f"{where}: {problem(error)}") from None
    folders = [place / found.model for place in (path.resolve().parent, MODELS)]
    own = [str(folder) for folder in folders if (folder / f"{folder.name}.xml").is_file()]
    model, speed, altitude = [*own, found.model][0], float(found.speed), float(found.altitude)
    return replace(found, autopilot=gains, model=model, speed=speed, altitude=altitude)


def build(
    cls: Any,  # The dataclass
    values: Any,  # Its fields by name
    where: str,  # The file or entry with these values, for messages
) -> Any:
    """Build a dataclass from a mapping."""
    optional = [f.name for f in fields(cls) if {f.default, f.default_factory} != {MISSING}]
    needed = [f.name for f in fields(cls) if f.name not in optional]
    try:
        return cls(**mapping(values, where, needed, optional))
    except EntryError as error:
        raise SimulationError(str(error)) from None
