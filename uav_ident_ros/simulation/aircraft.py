# SPDX-License-Identifier: Apache-2.0
"""JSBSim aircraft in trimmed flight: surfaces in, signals out, and their true derivatives.

JSBSim (LGPL, ``pip install jsbsim``) is a development extra: it is imported when an aircraft
is made. One step of JSBSim moves the state first and evaluates controls, forces and
accelerations after, so that what is read after a step belongs to one instant.
"""

import contextlib
import importlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.airframe import MODELS, airframe
from uav_ident_ros.simulation.flight import SimulationError

FOOT = 0.3048
"""Length of a foot, m."""

FULL_TRIM = 1
"""JSBSim's trim in all six degrees of freedom."""

TRIM_GUESS = (0.05, 0.0, 0.0, 0.0, 0.5)
"""Angle of attack, elevator, rudder, aileron (rad) and throttle to start a trim from."""

TRIM_STEP, TRIM_TOLERANCE, TRIM_ITERATIONS = 1e-4, 1e-6, 20
"""Perturbation of these; largest acceleration left, ft/s^2 and rad/s^2; steps of Newton's method,
which needs five."""

UNBALANCES = ("udot-ft_sec2", "wdot-ft_sec2", "pdot-rad_sec2", "qdot-rad_sec2", "rdot-rad_sec2")
"""Accelerations that a trim removes."""

SURFACES = (
    "fcs/elevator-pos-rad",
    "fcs/rudder-pos-rad",
    "fcs/left-aileron-pos-rad",
    "fcs/throttle-pos-norm",
)
COMMANDS = ("fcs/elevator-cmd-norm", "fcs/rudder-cmd-norm", "fcs/aileron-cmd-norm")
_TRIMS = ("fcs/pitch-trim-cmd-norm", "fcs/yaw-trim-cmd-norm", "fcs/roll-trim-cmd-norm")

OUTPUT = re.compile(r"<output\s[^>]*/>|<output\s[^>]*[^/]>.*?</output>", re.DOTALL)
"""Files that some aircraft write of themselves, in whatever folder they are flown. (The outputs of
their flight controls have no attributes.)"""

SETTLING_TIME = 20.0
"""Time on the autopilot before others fly an aircraft, s."""

AUTOPILOT_RATE = 100.0
"""Rate of that autopilot, Hz."""

COMMAND_POINTS = np.linspace(-1.0, 1.0, 81)
"""Commands between which a surface's travel is linear: about its centre it may have a corner, and
some stop short of the full command (the A4's rudder at 0.35 of it)."""

SIGNALS = {
    "p": "velocities/p-rad_sec",
    "q": "velocities/q-rad_sec",
    "r": "velocities/r-rad_sec",
    "pdot": "accelerations/pdot-rad_sec2",
    "qdot": "accelerations/qdot-rad_sec2",
    "rdot": "accelerations/rdot-rad_sec2",
    # all forces but the weight: over the mass, the specific force at the centre of gravity
    "fx": "forces/fbx-total-lbs",
    "fy": "forces/fby-total-lbs",
    "fz": "forces/fbz-total-lbs",
    "airspeed": "velocities/vtrue-fps",
    "alpha": "aero/alpha-rad",
    "beta": "aero/beta-rad",
    "roll": "attitude/phi-rad",
    "pitch": "attitude/theta-rad",
    "yaw": "attitude/psi-rad",
    "altitude": "position/h-sl-ft",
    **dict(zip(("elevator", "rudder", "aileron", "throttle"), SURFACES, strict=True)),
}
"""What is read after every step."""

Signals = Mapping[str, float]
"""`SIGNALS` by name, SI."""

BALLAST = """<pointmass name="ballast"><weight unit="LBS">0</weight><location unit="IN">
<x>0</x><y>0</y><z>0</z></location></pointmass>"""
"""Empty point mass, for `uav_ident_ros.simulation.faults`: JSBSim makes none in flight."""

BALLASTS = 5
"""Two for an inertia in roll, two in pitch, one for the centre of gravity."""


def _load(name: str, rate: float) -> Any:
    """Return a quiet JSBSim executive with the aircraft loaded."""
    os.environ.setdefault("JSBSIM_DEBUG", "0")  # or it prints a banner on stdout
    try:
        jsbsim = importlib.import_module("jsbsim")
    except ImportError:
        raise SimulationError(
            "JSBSim is not installed, which aircraft flights need: pip install jsbsim==1.3.3"
        ) from None
    fdm = jsbsim.FGFDMExec(None)
    fdm.set_debug_level(0)
    fdm.set_dt(1.0 / rate)
    own = MODELS / name
    source = own if own.is_dir() else Path(fdm.get_root_dir()) / "aircraft" / name
    with tempfile.TemporaryDirectory() as folder:
        if source.is_dir():
            model = Path(shutil.copytree(source, Path(folder) / name)) / f"{name}.xml"
            text = model.read_text(encoding="utf-8", errors="surrogateescape")
            text = text.replace("</mass_balance>", BALLASTS * BALLAST + "</mass_balance>", 1)
            text = OUTPUT.sub("", text)
            model.write_text(text, encoding="utf-8", errors="surrogateescape")
        fdm.set_aircraft_path(folder)
        with _explained(name):
            found = fdm.load_model(name)
        if not found:
            raise SimulationError(f"JSBSim has no aircraft '{name}': it is the 'model' of its file")
    return fdm


@contextlib.contextmanager
def _explained(name: str) -> Iterator[None]:
    """Turn what JSBSim raises into a sentence: its exceptions have no public base class."""
    try:
        yield
    except Exception as error:
        raise SimulationError(f"JSBSim cannot fly aircraft '{name}': {error}") from None


def _surface_ranges(name: str, rate: float) -> FloatArray:
    """Elevator, rudder and aileron at `COMMAND_POINTS`, shape (3, 81), rad."""
    fdm = _load(name, rate)
    with _explained(name):
        fdm.run_ic()
    out = np.empty((3, len(COMMAND_POINTS)))
    for i, command in enumerate(COMMAND_POINTS):
        for target in COMMANDS:
            fdm[target] = command
        fdm.run()
        out[:, i] = [fdm[surface] for surface in SURFACES[:3]]
    return out


class Aircraft:
    """JSBSim aircraft in trimmed flight: takes surfaces, gives signals."""

    def __init__(
        self,
        name: str,  # As in `airframe`
        rate: float,  # Rate of the simulation, Hz
        speed: float | None = None,  # True airspeed in place of its own, m/s
    ) -> None:
        self.airframe = airframe(name, speed)  # What it is
        self.rate = rate  # Rate of the simulation, Hz
        self._ranges = _surface_ranges(self.airframe.model, rate)
        # (2, 4) Least and largest elevator, rudder, aileron (rad) and throttle
        self.limits = np.column_stack([self._ranges[:, [0, -1]].T, (0.0, 1.0)])
        self.fdm = _load(self.airframe.model, rate)  # JSBSim itself, for what has no method here
        nodes = self.fdm.get_property_manager()
        self._read = {name: nodes.get_node(path) for name, path in SIGNALS.items()}
        self._mass = nodes.get_node("inertia/mass-slugs")
        self._command = [nodes.get_node(name) for name in COMMANDS]
        self._engines = self.fdm.get_propulsion().get_num_engines()
        suffixes = [""] + [f"[{i}]" for i in range(1, self._engines)]
        throttles = (nodes.get_node(f"fcs/throttle-cmd-norm{s}") for s in suffixes)
        self._throttle = [node for node in throttles if node is not None]  # a glider has none
        self._trim()
        # (4,) Elevator, rudder, aileron (rad) and throttle as last commanded
        self.surfaces = np.array([self.fdm[s] for s in SURFACES])

    def _trim(self) -> None:
        fdm = self.fdm
        fdm["ic/h-sl-ft"] = self.airframe.altitude / FOOT
        fdm["ic/vt-fps"] = self.airframe.speed / FOOT
        fdm["propulsion/set-running"] = -1
        fdm["gear/gear-cmd-norm"] = 0.0
        fdm["gear/gear-pos-norm"] = 0.0
        fdm.run_ic()
        fdm["propulsion/fuel_freeze"] = 1  # mass and inertia stay what they are
        trimmed = False
        if self._engines:  # it knows no other thrust
            with contextlib.suppress(Exception):  # jsbsim.TrimFailureError has no public base class
                fdm.do_trim(FULL_TRIM)
                trimmed = True
        if not trimmed:
            self._solve_trim()
        for name in _TRIMS:
            fdm[name] = 0.0  # the surfaces take over what the trim tabs held

    def _solve_trim(self) -> None:
        """Trim by Newton's method, where JSBSim's own trim fails."""
        x = np.array(TRIM_GUESS)
        for _ in range(TRIM_ITERATIONS):
            rest = self._unbalance(x)
            if np.abs(rest).max() < TRIM_TOLERANCE:
                return
            steps = TRIM_STEP * np.eye(len(x))
            jacobian = np.array([self._unbalance(x + step) - rest for step in steps]).T / TRIM_STEP
            x = x - np.linalg.lstsq(jacobian, rest, rcond=None)[0]
        raise SimulationError(
            f"JSBSim aircraft '{self.airframe.name}' cannot be trimmed at "
            f"{self.airframe.speed:.1f} m/s and {self.airframe.altitude:.0f} m"
        )

    def _unbalance(
        self,
        x: FloatArray,  # (5,) Angle of attack, elevator, rudder, aileron, rad; throttle
    ) -> FloatArray:
        """Accelerations in level flight, shape (5,)."""
        self.fdm["ic/alpha-rad"] = self.fdm["ic/theta-rad"] = float(x[0])
        self.set_surfaces(self.clip(x[1:]))
        self.fdm.run_ic()
        return np.array([self.fdm[f"accelerations/{name}"] for name in UNBALANCES])

    def set_surfaces(self, surfaces: FloatArray) -> None:
        """Command elevator, rudder, aileron (rad) and throttle from now on."""
        self.surfaces = surfaces
        for i, node in enumerate(self._command):
            node.set_double_value(float(np.interp(surfaces[i], self._ranges[i], COMMAND_POINTS)))
        for node in self._throttle:
            node.set_double_value(float(surfaces[3]))

    def stop_engine(self) -> None:
        """Let an engine fail: the last of several, the only one, or the motor without a name."""
        if self._engines:
            self.fdm[f"propulsion/engine[{self._engines - 1}]/set-running"] = 0
            self.fdm["propulsion/active_engine"] = self._engines - 1
            self.fdm["propulsion/cutoff_cmd"] = 1
        if self._throttle:
            self._throttle.pop().set_double_value(0.0)

    def clip(self, surfaces: FloatArray) -> FloatArray:
        """Limit surfaces to what the aircraft can do."""
        return np.clip(surfaces, *self.limits)

    def step(self) -> Signals:
        """Move on by one step; return the signals."""
        self.fdm.run()
        signals = {name: node.get_double_value() for name, node in self._read.items()}
        for name in ("airspeed", "altitude"):
            signals[name] *= FOOT
        per_mass = FOOT / self._mass.get_double_value()
        for name in ("fx", "fy", "fz"):
            signals[name] *= per_mass
        return signals


class Autopilot:
    """Attitude, altitude and speed hold; low gains, so that the excitation comes through."""

    def __init__(self, aircraft: Aircraft, signals: Signals, rate: float) -> None:
        self.airframe, self.trim, self.rate = aircraft.airframe, aircraft.surfaces, rate
        self.pitch, self.altitude = signals["pitch"], signals["altitude"]

    def surfaces(self, signals: Signals, bank: float = 0.0) -> FloatArray:
        """Elevator, rudder, aileron, throttle from the signals, at `rate` Hz."""
        a, gains = self.airframe, self.airframe.autopilot
        before, self.altitude = self.altitude, signals["altitude"]
        climb = (self.altitude - before) * self.rate
        reference = self.pitch + gains.altitude_gain * (a.altitude - self.altitude)
        pitch_error = signals["pitch"] - (reference - gains.climb_gain * climb)
        correction = np.array(
            [
                gains.pitch_gain * pitch_error + gains.pitch_damping * signals["q"],
                0.0,
                -gains.roll_gain * (signals["roll"] - bank),
                gains.speed_gain * (a.speed - signals["airspeed"]),
            ]
        )
        return np.asarray(self.trim + correction)


def settle(aircraft: Aircraft, rate: float = AUTOPILOT_RATE) -> tuple[Autopilot, Signals]:
    """Fly a trimmed aircraft on the autopilot, at `rate` Hz, until nothing moves any more.

    Returns what flies it and the signals at the end; the surfaces are ``aircraft.surfaces``.
    """
    signals = aircraft.step()
    autopilot, every = Autopilot(aircraft, signals, rate), round(aircraft.rate / rate)
    for _ in range(round(SETTLING_TIME * rate)):
        aircraft.set_surfaces(aircraft.clip(autopilot.surfaces(signals)))
        for _ in range(every - 1):  # nobody looks at these
            aircraft.fdm.run()
        signals = aircraft.step()
    return autopilot, signals


# --- true derivatives where it flies --------------------------------------------------------------


STATES = {
    "p": "ic/p-rad_sec",
    "q": "ic/q-rad_sec",
    "r": "ic/r-rad_sec",
    "beta": "ic/beta-rad",
    "alpha": "ic/alpha-rad",
}
"""States of the linear model, rad/s and rad, and the properties that set them."""

ROWS = ("pdot", "qdot", "rdot", "ay", "az", "betadot", "alphadot")
"""What is differentiated: rad/s^2, m/s^2 (specific force at the centre of gravity), rad/s."""

STEP = 1e-3
"""Perturbation of a state (rad/s, rad) or an input (rad, throttle 0..1). JSBSim's tables are
piecewise linear over a degree and more, its numbers are doubles: so it is neither too long nor
too short."""

SIMULATION_RATE = 200.0
"""Rate at which an aircraft settles at its cruise point, Hz: at 1 kHz it is the same one."""

LEAST_DERIVATIVE = 0.01
"""Derivatives up to this size are left out of `cruise_derivatives`; in the units of `ROWS`."""

_KEPT = {
    "ic/h-sl-ft": "position/h-sl-ft",
    "ic/vt-fps": "velocities/vt-fps",
    "ic/alpha-rad": "aero/alpha-rad",
    "ic/beta-rad": "aero/beta-rad",
    "ic/phi-rad": "attitude/phi-rad",
    "ic/theta-rad": "attitude/theta-rad",
    "ic/psi-true-rad": "attitude/psi-rad",
    "ic/p-rad_sec": "velocities/p-rad_sec",
    "ic/q-rad_sec": "velocities/q-rad_sec",
    "ic/r-rad_sec": "velocities/r-rad_sec",
}
"""Properties that make an initial condition of a flight's state, in the order of writing."""


@dataclass(frozen=True)
class Linearisation:
    """Derivatives of an aircraft about a flight condition."""

    # By name, ``pdot/da`` and so on: of `ROWS` by `STATES` at a fixed attitude, airspeed and
    # surfaces, and by the inputs at fixed states; ``betadot/p`` without the model's own p alpha
    derivatives: dict[str, float]
    airspeed: float  # True, m/s


def linearise_cruise(
    name: str,  # As in `uav_ident_ros.simulation.airframe`
    speed: float | None = None,  # True airspeed in place of its own, m/s
) -> Linearisation:
    """Linearise an aircraft in steady, calm flight."""
    aircraft = Aircraft(name, SIMULATION_RATE, speed)
    settle(aircraft)
    return linearise(aircraft)


@lru_cache
def cruise_derivatives(name: str, speed: float | None = None) -> dict[str, float]:
    """Return the derivatives of `linearise_cruise`, by name, for people and files to read.

    Four figures; without those by the throttle, which an engine follows late, and without those
    that are next to nothing.
    """
    found = linearise_cruise(name, speed).derivatives
    return {
        key: float(f"{value:.4g}")
        for key, value in found.items()
        if abs(value) > LEAST_DERIVATIVE and not key.endswith("/dth")
    }


def linearise(aircraft: Aircraft) -> Linearisation:
    """Differentiate an aircraft where it is, with the surfaces and the mass that it has.

    Nothing is fitted: central differences of its accelerations. JSBSim is put into the state it is
    in, a little to one side and to the other, with the surfaces it has, and says what the
    accelerations are there. Engine speed, fuel and mass stay; the throttle's derivatives are those
    at the speed that the engine has, not a second later.

    Best in steady, calm flight. Afterwards the aircraft is in the same state as before, at
    latitude and longitude zero.
    """
    fdm, surfaces = aircraft.fdm, aircraft.surfaces
    state = {name: float(fdm[now]) for name, now in _KEPT.items()}
    base = _signals(aircraft, state)

    def slope(changed: str, moved: FloatArray) -> FloatArray:
        ends = []
        for step in (STEP, -STEP):
            aircraft.set_surfaces(surfaces + step * moved)
            there = {changed: state[changed] + step} if changed else {}
            signals = _signals(aircraft, state | there)
            rows = [signals[name] for name in ("pdot", "qdot", "rdot", "fy", "fz")]
            flow = [fdm[f"aero/{angle}dot-rad_sec"] for angle in ("beta", "alpha")]
            ends.append(np.array([*rows, *flow]))
        return np.asarray((ends[0] - ends[1]) / (2.0 * STEP))

    still = np.zeros(len(INPUTS))
    columns = {name: slope(changed, still) for name, changed in STATES.items()}
    columns |= {name: slope("", one) for name, one in zip(INPUTS, np.eye(len(INPUTS)), strict=True)}
    aircraft.set_surfaces(surfaces)
    _signals(aircraft, state)
    derivatives = {
        f"{row}/{name}": float(column[k])
        for k, row in enumerate(ROWS)
        for name, column in columns.items()
    }
    # The model's own term p alpha counts alpha from where az vanishes; the rest is the coefficient.
    derivatives["betadot/p"] -= base["fz"] / derivatives["az/alpha"]
    return Linearisation(derivatives, base["airspeed"])


def _signals(aircraft: Aircraft, state: Mapping[str, float]) -> Signals:
    """Return the signals in a state."""
    fdm = aircraft.fdm
    for name, value in state.items():
        fdm[name] = value
    fdm.run_ic()
    fdm.suspend_integration()  # no time passes
    # once for the flow angles' rates, which JSBSim's moments may use, and once with them
    aircraft.step()
    signals = aircraft.step()
    fdm.resume_integration()
    return signals
