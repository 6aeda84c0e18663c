# SPDX-License-Identifier: Apache-2.0
"""JSBSim aircraft in trimmed flight: surfaces in, signals out, one step at a time.

JSBSim (LGPL, ``pip install jsbsim``) is a development extra: it is imported when an aircraft
is made. One step of JSBSim moves the state first and evaluates controls, forces and
accelerations after, so that what is read after a step belongs to one instant.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.errors import SimulationError

FOOT = 0.3048
"""Length of a foot, m."""

FULL_TRIM = 1
"""JSBSim's trim in all six degrees of freedom."""

TURBULENCE_TUSTIN = 4
"""JSBSim's MIL-F-8785C turbulence, discretised by Tustin's rule."""

MAX_TURBULENCE = 7
"""Highest probability-of-exceedance index of JSBSim's turbulence."""

WIND_AT_20_FEET = 25.0
"""Low-altitude wind of the turbulence model, ft/s; it matters below 2000 ft only."""

SURFACES = (
    "fcs/elevator-pos-rad",
    "fcs/rudder-pos-rad",
    "fcs/left-aileron-pos-rad",
    "fcs/throttle-pos-norm",
)
COMMANDS = ("fcs/elevator-cmd-norm", "fcs/rudder-cmd-norm", "fcs/aileron-cmd-norm")
_TRIMS = ("fcs/pitch-trim-cmd-norm", "fcs/yaw-trim-cmd-norm", "fcs/roll-trim-cmd-norm")

COMMAND_POINTS = (-1.0, 0.0, 1.0)
"""Commands between which a surface's travel is linear."""

# What is read after every step, and the factor that makes it SI.
SIGNALS = {
    "p": ("velocities/p-rad_sec", 1.0),
    "q": ("velocities/q-rad_sec", 1.0),
    "r": ("velocities/r-rad_sec", 1.0),
    "pdot": ("accelerations/pdot-rad_sec2", 1.0),
    "qdot": ("accelerations/qdot-rad_sec2", 1.0),
    "rdot": ("accelerations/rdot-rad_sec2", 1.0),
    # all forces but the weight: over the mass, the specific force at the centre of gravity
    "fx": ("forces/fbx-total-lbs", 1.0),
    "fy": ("forces/fby-total-lbs", 1.0),
    "fz": ("forces/fbz-total-lbs", 1.0),
    "airspeed": ("velocities/vtrue-fps", FOOT),
    "alpha": ("aero/alpha-rad", 1.0),
    "beta": ("aero/beta-rad", 1.0),
    "roll": ("attitude/phi-rad", 1.0),
    "pitch": ("attitude/theta-rad", 1.0),
    "yaw": ("attitude/psi-rad", 1.0),
    "altitude": ("position/h-sl-ft", FOOT),
    "elevator": (SURFACES[0], 1.0),
    "rudder": (SURFACES[1], 1.0),
    "aileron": (SURFACES[2], 1.0),
    "throttle": (SURFACES[3], 1.0),
}
COLUMN = {name: i for i, name in enumerate(SIGNALS)}


@dataclass(frozen=True)
class Airframe:
    """A JSBSim aircraft and how it is flown here.

    Parameters
    ----------
    speed : float
        True airspeed, m/s.
    altitude : float
        Above sea level, m.
    roll_gain, pitch_gain : float
        Aileron per rad of roll error, elevator per rad of pitch error.
    pitch_damping : float
        Elevator per rad/s of pitch rate.
    altitude_gain, climb_gain : float
        Pitch reference per m of altitude error and per m/s of climb, rad.
    speed_gain : float
        Throttle per m/s of speed error.
    local_truth : mapping
        Local derivatives in this flight condition, 1/s or 1/s^2 per rad.
    """

    speed: float
    altitude: float
    roll_gain: float
    pitch_gain: float
    pitch_damping: float = 0.0
    altitude_gain: float = 1e-3
    climb_gain: float = 5e-3
    speed_gain: float = 0.02
    local_truth: Mapping[str, float] = field(default_factory=dict)


AIRFRAMES: dict[str, Airframe] = {
    # Four-seat propeller aircraft, 853 kg, at 175 ft/s and 3000 ft.
    "c172p": Airframe(
        speed=175.0 * FOOT,
        altitude=3000.0 * FOOT,
        roll_gain=0.1,
        pitch_gain=0.15,
        local_truth={
            "pdot/p": -6.81, "pdot/r": 1.38, "pdot/dr": 3.24, "pdot/da": 31.2,
            "pdot/beta": -15.5,
            "qdot/q": -5.59, "qdot/de": -27.3, "qdot/alpha": -33.4,
            "rdot/p": -0.277, "rdot/r": -0.785, "rdot/dr": -4.33, "rdot/da": -0.230,
            "rdot/beta": 4.83,
        },
    ),
    # Jet trainer with two engines, 2.2 t.
    "T37": Airframe(
        speed=420.0 * FOOT,
        altitude=10000.0 * FOOT,
        roll_gain=0.05,
        pitch_gain=0.1,
        # by regression of the noise-free accelerations of calm flights
        local_truth={
            "pdot/p": -2.10, "pdot/r": 0.465, "pdot/dr": 2.23, "pdot/da": 17.76,
            "pdot/beta": -11.84,
            "qdot/q": -9.37, "qdot/de": -23.1, "qdot/alpha": -14.2,
            "rdot/p": -0.144, "rdot/r": -0.481, "rdot/dr": -3.01, "rdot/da": -2.05,
            "rdot/beta": 9.12,
        },
    ),
    # Turboprop with two engines, 6.7 t.
    "OV10": Airframe(
        speed=290.0 * FOOT,
        altitude=5000.0 * FOOT,
        roll_gain=0.1,
        pitch_gain=0.2,
        # by regression, as above
        local_truth={
            "pdot/p": -1.307, "pdot/r": 0.485, "pdot/dr": 0.439, "pdot/da": 7.18,
            "pdot/beta": -5.74,
            "qdot/q": -1.764, "qdot/de": -4.17, "qdot/alpha": -1.164,
            "rdot/p": -0.008, "rdot/r": -0.465, "rdot/dr": -1.646, "rdot/da": -0.042,
            "rdot/beta": 4.01,
        },
    ),
}  # fmt: skip
"""Aircraft that fly here, by JSBSim's name."""


def airframe(name: str) -> Airframe:
    """Return how an aircraft is flown here.

    Raises
    ------
    SimulationError
        If it is not set up here.
    """
    if name not in AIRFRAMES:
        raise SimulationError(
            f"JSBSim aircraft '{name}' is not set up here: use one of {', '.join(AIRFRAMES)}"
        )
    return AIRFRAMES[name]


def _load(name: str, rate: float) -> Any:
    """Return a quiet JSBSim executive with the aircraft loaded.

    Raises
    ------
    SimulationError
        If JSBSim is not installed or has no such aircraft.
    """
    before = os.environ.get("JSBSIM_DEBUG")
    os.environ["JSBSIM_DEBUG"] = "0"  # or it prints a banner on stdout
    try:
        jsbsim = importlib.import_module("jsbsim")
        fdm = jsbsim.FGFDMExec(None)
    except ImportError:
        raise SimulationError(
            "JSBSim is not installed, which aircraft flights need: pip install jsbsim==1.3.3"
        ) from None
    finally:
        if before is None:
            del os.environ["JSBSIM_DEBUG"]
        else:
            os.environ["JSBSIM_DEBUG"] = before
    fdm.set_debug_level(0)
    fdm.disable_output()  # some aircraft write files of their own
    fdm.set_dt(1.0 / rate)
    if not fdm.load_model(name):
        raise SimulationError(f"JSBSim has no aircraft '{name}'")
    return fdm


def _surface_ranges(name: str, rate: float) -> FloatArray:
    """Elevator, rudder and aileron at commands -1, 0, 1, shape (3, 3), rad."""
    fdm = _load(name, rate)
    fdm.run_ic()
    out = np.empty((3, 3))
    for i, command in enumerate(COMMAND_POINTS):
        for target in COMMANDS:
            fdm[target] = command
        fdm.run()
        out[:, i] = [fdm[surface] for surface in SURFACES[:3]]
    return out


class Aircraft:
    """JSBSim aircraft in trimmed flight: takes surfaces, gives signals.

    Parameters
    ----------
    name : str
        One of `AIRFRAMES`.
    rate : float
        Rate of the simulation, Hz.

    Attributes
    ----------
    fdm : jsbsim.FGFDMExec
        JSBSim itself, for what has no method here.
    surfaces : (4,) array
        Elevator, rudder, aileron (rad) and throttle as last commanded.

    Raises
    ------
    SimulationError
        If JSBSim is not installed, or has no such aircraft, or cannot trim it.
    """

    def __init__(self, name: str, rate: float) -> None:
        self.airframe = airframe(name)
        self.ranges = _surface_ranges(name, rate)
        self.fdm = _load(name, rate)
        self._trim(name)
        nodes = self.fdm.get_property_manager()
        self._read = [nodes.get_node(name) for name, _ in SIGNALS.values()]
        self._scale = np.array([scale for _, scale in SIGNALS.values()])
        self._command = [nodes.get_node(name) for name in COMMANDS]
        engines = int(self.fdm["propulsion/engine-count"]) if self._counts_engines() else 1
        suffixes = [""] + [f"[{i}]" for i in range(1, engines)]
        self._throttle = [nodes.get_node(f"fcs/throttle-cmd-norm{s}") for s in suffixes]
        self.surfaces = np.array([self.fdm[s] for s in SURFACES])

    @property
    def mass(self) -> float:
        """Mass, slug."""
        return float(self.fdm["inertia/mass-slugs"])

    def _counts_engines(self) -> bool:
        return bool(self.fdm.get_property_manager().hasNode("propulsion/engine-count"))

    def _trim(self, name: str) -> None:
        fdm = self.fdm
        fdm["ic/h-sl-ft"] = self.airframe.altitude / FOOT
        fdm["ic/vt-fps"] = self.airframe.speed / FOOT
        fdm["propulsion/set-running"] = -1
        fdm["gear/gear-cmd-norm"] = 0.0
        fdm["gear/gear-pos-norm"] = 0.0
        fdm.run_ic()
        fdm["propulsion/fuel_freeze"] = 1  # mass and inertia stay what they are
        try:
            fdm.do_trim(FULL_TRIM)
        except Exception as error:  # jsbsim.TrimFailureError is no public base class
            raise SimulationError(f"JSBSim cannot trim '{name}': {error}") from None
        for name in _TRIMS:
            fdm[name] = 0.0  # the surfaces take over what the trim tabs held

    def set_surfaces(self, surfaces: FloatArray) -> None:
        """Command elevator, rudder, aileron (rad) and throttle from now on."""
        self.surfaces = surfaces
        for i, node in enumerate(self._command):
            node.set_double_value(float(np.interp(surfaces[i], self.ranges[i], COMMAND_POINTS)))
        for node in self._throttle:
            node.set_double_value(float(surfaces[3]))

    def clip(self, surfaces: FloatArray) -> FloatArray:
        """Limit surfaces to what the aircraft can do."""
        low, high = np.append(self.ranges[:, 0], 0.0), np.append(self.ranges[:, 2], 1.0)
        return np.clip(surfaces, low, high)

    def step(self) -> list[float]:
        """Move on by one step; the signals in the order of `SIGNALS`, in JSBSim's units."""
        self.fdm.run()
        return [node.get_double_value() for node in self._read]

    def to_si(self, record: FloatArray) -> FloatArray:
        """Signals in SI units; specific force in place of the forces."""
        record = record * self._scale
        record[..., 6:9] *= FOOT / self.mass
        return record


class Autopilot:
    """Attitude, altitude and speed hold; low gains, so that the excitation comes through."""

    def __init__(self, airframe: Airframe, trim: FloatArray, pitch: float) -> None:
        self.airframe, self.trim, self.pitch = airframe, trim, pitch

    def surfaces(self, signals: Sequence[float], climb: float, bank: float) -> FloatArray:
        """Elevator, rudder, aileron, throttle from the signals (JSBSim's units)."""
        a = self.airframe
        altitude = signals[COLUMN["altitude"]] * FOOT
        speed = signals[COLUMN["airspeed"]] * FOOT
        reference = self.pitch + a.altitude_gain * (a.altitude - altitude) - a.climb_gain * climb
        pitch_error = signals[COLUMN["pitch"]] - reference
        roll_error = signals[COLUMN["roll"]] - bank
        correction = np.array(
            [
                a.pitch_gain * pitch_error + a.pitch_damping * signals[COLUMN["q"]],
                0.0,
                -a.roll_gain * roll_error,
                a.speed_gain * (a.speed - speed),
            ]
        )
        return np.asarray(self.trim + correction)


def start_turbulence(fdm: Any, severity: int, seed: int) -> None:
    """Let the air become turbulent, 0 (calm) to `MAX_TURBULENCE`."""
    if severity:
        fdm["simulation/randomseed"] = seed
        fdm["atmosphere/randomseed"] = seed
        fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = WIND_AT_20_FEET
        fdm["atmosphere/turbulence/milspec/severity"] = severity
        fdm["atmosphere/turb-type"] = TURBULENCE_TUSTIN
