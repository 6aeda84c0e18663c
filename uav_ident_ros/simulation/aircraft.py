# SPDX-License-Identifier: Apache-2.0
"""JSBSim aircraft in trimmed flight: surfaces in, signals out; and their true derivatives.

JSBSim (LGPL, ``pip install jsbsim``) is a development extra: it is imported when an aircraft
is made. A step of JSBSim first integrates the state, then evaluates controls, forces and
accelerations. All values read after a step therefore belong to one instant.
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

from uav_ident_ros.identification.structure import INPUTS, STRUCTURES, FloatArray
from uav_ident_ros.simulation.airframe import airframe
from uav_ident_ros.simulation.channels import PLAIN
from uav_ident_ros.simulation.flight import SimulationError

FOOT = 0.3048
"""Length of a foot, m."""

TRIM_GUESS = (0.05, 0.0, 0.0, 0.0, 0.5)
"""Initial guess of a trim: angle of attack, elevator, rudder, aileron (rad) and throttle."""

TRIM_STEP, TRIM_TOLERANCE, TRIM_ITERATIONS = 1e-4, 1e-6, 20
"""Perturbation of these; largest remaining acceleration, ft/s^2 and rad/s^2; most steps of Newton's
method, which needs five."""

UNBALANCES = ("udot-ft_sec2", "wdot-ft_sec2", "pdot-rad_sec2", "qdot-rad_sec2", "rdot-rad_sec2")
"""Accelerations that are zero in trim."""

SURFACE_PROPERTIES = (
    "fcs/elevator-pos-rad",
    "fcs/rudder-pos-rad",
    "fcs/left-aileron-pos-rad",
    "fcs/throttle-pos-norm",
)
COMMAND_PROPERTIES = ("fcs/elevator-cmd-norm", "fcs/rudder-cmd-norm", "fcs/aileron-cmd-norm")

OUTPUT = re.compile(r"<output\s[^>]*/>|<output\s[^>]*[^/]>.*?</output>", re.DOTALL)
"""Output files that some aircraft models declare; JSBSim writes them into the current folder. The
outputs of their flight controls have no attributes."""

SETTLING_TIME = 20.0
"""Time on the autopilot before a controller takes over, s."""

AUTOPILOT_RATE = 100.0
"""Rate of the autopilot, Hz."""

COMMAND_POINTS = np.linspace(-1.0, 1.0, 81)
"""Commands at which surface deflections are tabulated, linear in between. A deflection may have a
kink at the centre or saturate before full command (the A4's rudder at 0.35 of it)."""

PROPERTIES = {
    "p": "velocities/p-rad_sec",
    "q": "velocities/q-rad_sec",
    "r": "velocities/r-rad_sec",
    "pdot": "accelerations/pdot-rad_sec2",
    "qdot": "accelerations/qdot-rad_sec2",
    "rdot": "accelerations/rdot-rad_sec2",
    # all forces except the weight; divided by the mass: specific force at the centre of gravity
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
    **dict(zip(PLAIN.names, SURFACE_PROPERTIES, strict=True)),
}
"""Properties read after every step, by the name of the signal."""

Signals = Mapping[str, float]
"""`PROPERTIES` by name, SI."""

BALLAST = """<pointmass name="ballast"><weight unit="LBS">0</weight><location unit="IN">
<x>0</x><y>0</y><z>0</z></location></pointmass>"""
"""Empty point mass, for `uav_ident_ros.simulation.faults`: JSBSim cannot add one in flight."""

BALLASTS = 5
"""Number of point masses: two for roll inertia, two for pitch inertia, one for the centre of
gravity."""


def _load(model: str, rate: float) -> Any:
    """Return a JSBSim executive with a model loaded and without console output."""
    os.environ.setdefault("JSBSIM_DEBUG", "0")  # otherwise JSBSim prints a banner on stdout
    try:
        jsbsim = importlib.import_module("jsbsim")
    except ImportError:
        raise SimulationError(
            "JSBSim is not installed, which aircraft flights need: pip install jsbsim==1.3.3"
        ) from None
    fdm = jsbsim.FGFDMExec(None)
    fdm.set_debug_level(0)
    fdm.set_dt(1.0 / rate)
    source = Path(fdm.get_root_dir()) / "aircraft" / model  # the model itself if it is a path
    name = source.name
    with tempfile.TemporaryDirectory() as folder:
        if source.is_dir():
            file = Path(shutil.copytree(source, Path(folder) / name)) / f"{name}.xml"
            text = file.read_text(encoding="utf-8", errors="surrogateescape")
            text = text.replace("</mass_balance>", BALLASTS * BALLAST + "</mass_balance>", 1)
            text = OUTPUT.sub("", text)
            file.write_text(text, encoding="utf-8", errors="surrogateescape")
        fdm.set_aircraft_path(folder)
        with _explained(model):
            found = fdm.load_model(name)
        if not found:
            raise SimulationError(
                f"JSBSim has no aircraft '{model}', the 'model' of its file: write one that comes "
                "with JSBSim, or a folder beside the file, NAME, with NAME/NAME.xml in it"
            )
    return fdm


@contextlib.contextmanager
def _explained(name: str) -> Iterator[None]:
    """Turn any exception of JSBSim into a `SimulationError`: they have no public base class."""
    try:
        yield
    except Exception as error:
        raise SimulationError(f"JSBSim cannot fly aircraft '{name}': {error}") from None


def _surface_ranges(model: str, rate: float) -> FloatArray:
    """Return elevator, rudder and aileron at `COMMAND_POINTS`, shape (3, 81), rad."""
    fdm = _load(model, rate)
    with _explained(model):
        fdm.run_ic()
    out = np.empty((3, len(COMMAND_POINTS)))
    for i, command in enumerate(COMMAND_POINTS):
        for target in COMMAND_PROPERTIES:
            fdm[target] = command
        fdm.run()
        out[:, i] = [fdm[surface] for surface in SURFACE_PROPERTIES[:3]]
    return out


class Aircraft:
    """JSBSim aircraft, initially in trimmed flight: surfaces in, signals out."""

    def __init__(
        self,
        name: str,  # As in `airframe`
        rate: float,  # Rate of the simulation, Hz
        speed: float | None = None,  # True airspeed in place of the airframe's, m/s
    ) -> None:
        self.airframe = airframe(name, speed)  # Its description
        self.rate = rate  # Rate of the simulation, Hz
        self._ranges = _surface_ranges(self.airframe.model, rate)
        # (2, 4) Limits of elevator, rudder, aileron (rad) and throttle: lower, upper
        self.limits = np.column_stack([self._ranges[:, [0, -1]].T, (0.0, 1.0)])
        self.fdm = _load(self.airframe.model, rate)  # JSBSim's executive, for direct access
        nodes = self.fdm.get_property_manager()
        self._read = {name: nodes.get_node(path) for name, path in PROPERTIES.items()}
        self._mass = nodes.get_node("inertia/mass-slugs")
        self._command = [nodes.get_node(name) for name in COMMAND_PROPERTIES]
        self._engines = self.fdm.get_propulsion().get_num_engines()
        suffixes = [""] + [f"[{i}]" for i in range(1, self._engines)]
        throttles = (nodes.get_node(f"fcs/throttle-cmd-norm{s}") for s in suffixes)
        self._throttle = [node for node in throttles if node is not None]  # a glider has none
        self._trim()
        # (4,) Elevator, rudder, aileron (rad) and throttle as last commanded
        self.surfaces = np.array([self.fdm[s] for s in SURFACE_PROPERTIES])

    def _trim(self) -> None:
        fdm = self.fdm
        fdm["ic/h-sl-ft"] = self.airframe.altitude / FOOT
        fdm["ic/vt-fps"] = self.airframe.speed / FOOT
        fdm["propulsion/set-running"] = -1
        fdm["gear/gear-cmd-norm"] = 0.0
        fdm["gear/gear-pos-norm"] = 0.0
        fdm.run_ic()
        fdm["propulsion/fuel_freeze"] = 1  # constant mass and inertia
        trimmed = False
        if self._engines:  # JSBSim's trim needs an engine
            with contextlib.suppress(Exception):  # jsbsim.TrimFailureError has no public base class
                fdm.do_trim(1)  # in all six degrees of freedom
                trimmed = True
        if not trimmed:
            self._solve_trim()
        for axis in ("pitch", "yaw", "roll"):
            fdm[f"fcs/{axis}-trim-cmd-norm"] = 0.0  # the surfaces replace the trim tabs

    def _solve_trim(self) -> None:
        """Trim by Newton's method if JSBSim's own trim fails."""
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
        """Return the `UNBALANCES` in level flight, shape (5,)."""
        self.fdm["ic/alpha-rad"] = self.fdm["ic/theta-rad"] = float(x[0])
        self.set_surfaces(self.clip(x[1:]))
        self.fdm.run_ic()
        return np.array([self.fdm[f"accelerations/{name}"] for name in UNBALANCES])

    def set_surfaces(self, surfaces: FloatArray) -> None:
        """Set the command of elevator, rudder, aileron (rad) and throttle."""
        self.surfaces = surfaces
        for i, node in enumerate(self._command):
            node.set_double_value(float(np.interp(surfaces[i], self._ranges[i], COMMAND_POINTS)))
        for node in self._throttle:
            node.set_double_value(float(surfaces[3]))

    def stop_engine(self) -> None:
        """Make an engine fail: the last of several, the only one, or the unnamed motor."""
        if self._engines:
            self.fdm[f"propulsion/engine[{self._engines - 1}]/set-running"] = 0
            self.fdm["propulsion/active_engine"] = self._engines - 1
            self.fdm["propulsion/cutoff_cmd"] = 1
        if self._throttle:
            self._throttle.pop().set_double_value(0.0)

    def clip(self, surfaces: FloatArray) -> FloatArray:
        """Return the surfaces limited to the aircraft's range."""
        return np.clip(surfaces, *self.limits)

    def step(self) -> Signals:
        """Simulate one step; return the signals."""
        self.fdm.run()
        signals = {name: node.get_double_value() for name, node in self._read.items()}
        for name in ("airspeed", "altitude"):
            signals[name] *= FOOT
        per_mass = FOOT / self._mass.get_double_value()
        for name in ("fx", "fy", "fz"):
            signals[name] *= per_mass
        return signals


class Autopilot:
    """Attitude, altitude and speed hold, with low gains that do not cancel the excitation."""

    def __init__(self, aircraft: Aircraft, signals: Signals, rate: float) -> None:
        self.airframe, self.trim, self.rate = aircraft.airframe, aircraft.surfaces, rate
        self.pitch, self.altitude = signals["pitch"], signals["altitude"]

    def surfaces(self, signals: Signals, bank: float = 0.0) -> FloatArray:
        """Return elevator, rudder, aileron, throttle for the signals; call it at `rate` Hz."""
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
    """Fly a trimmed aircraft on the autopilot, at `rate` Hz, until the flight is steady.

    Returns the autopilot and the final signals; the surfaces are ``aircraft.surfaces``.
    """
    signals = aircraft.step()
    autopilot, every = Autopilot(aircraft, signals, rate), round(aircraft.rate / rate)
    for _ in range(round(SETTLING_TIME * rate)):
        aircraft.set_surfaces(aircraft.clip(autopilot.surfaces(signals)))
        for _ in range(every - 1):  # between two commands
            aircraft.fdm.run()
        signals = aircraft.step()
    return autopilot, signals


# --- true derivatives at a flight condition -------------------------------------------------------


STATES = ("p", "q", "r", "beta", "alpha")
"""States of the linear model, rad/s and rad."""

MODEL_ROWS = STRUCTURES["flight_dynamics"].row_labels
"""Rows of the linear model: rad/s^2, m/s^2 (specific force at the centre of gravity), rad/s."""

PERTURBATION = 1e-3
"""Perturbation of a state (rad/s, rad) or an input (rad, throttle 0..1): well below a degree, over
which JSBSim's tables are linear, and well above the rounding of doubles."""

SETTLING_RATE = 200.0
"""Simulation rate for settling at the cruise condition, Hz; 1 kHz gives the same condition."""

LEAST_DERIVATIVE = 0.01
"""Smallest derivative that `cruise_derivatives` contains, in the units of `MODEL_ROWS`."""

INITIAL = {
    "altitude": "ic/h-sl-ft",
    "airspeed": "ic/vt-fps",
    "alpha": "ic/alpha-rad",
    "beta": "ic/beta-rad",
    "roll": "ic/phi-rad",
    "pitch": "ic/theta-rad",
    "yaw": "ic/psi-true-rad",
    "p": "ic/p-rad_sec",
    "q": "ic/q-rad_sec",
    "r": "ic/r-rad_sec",
}
"""Properties of an initial condition by the name of the signal, in the order of writing."""


@dataclass(frozen=True)
class Linearisation:
    """Derivatives of an aircraft about a flight condition."""

    # By name such as ``pdot/da``: of `MODEL_ROWS` by `STATES` at fixed attitude, airspeed
    # and surfaces, and by the inputs at fixed states; ``betadot/p`` excludes the model's
    # own term p alpha
    derivatives: dict[str, float]
    airspeed: float  # True, m/s


def linearise_cruise(
    name: str,  # As in `uav_ident_ros.simulation.airframe`
    speed: float | None = None,  # True airspeed in place of the airframe's, m/s
) -> Linearisation:
    """Linearise an aircraft in steady, calm flight."""
    aircraft = Aircraft(name, SETTLING_RATE, speed)
    settle(aircraft)
    return differentiate(aircraft)


@lru_cache
def cruise_derivatives(name: str, speed: float | None) -> dict[str, float]:
    """Return the derivatives of `linearise_cruise` by name, to four figures.

    Derivatives with respect to throttle are omitted, because an engine follows it slowly; so are
    derivatives below `LEAST_DERIVATIVE`.
    """
    found = linearise_cruise(name, speed).derivatives
    return {
        key: float(f"{value:.4g}")
        for key, value in found.items()
        if abs(value) > LEAST_DERIVATIVE and not key.endswith("/dth")
    }


def differentiate(aircraft: Aircraft) -> Linearisation:
    """Linearise an aircraft about its present state, surfaces and mass.

    The derivatives are central differences of JSBSim's accelerations, each about the present state
    and surfaces. Engine speed, fuel and mass are constant; derivatives with respect to throttle
    therefore exclude the engine's spool-up.

    Steady, calm flight gives the best result. The state is restored afterwards, at latitude and
    longitude zero.
    """
    fdm, surfaces = aircraft.fdm, aircraft.surfaces
    state = {name: float(fdm[PROPERTIES[name]]) for name in INITIAL}
    base = _signals(aircraft, state)

    def slope(name: str) -> FloatArray:
        ends = []
        for step in (PERTURBATION, -PERTURBATION):
            aircraft.set_surfaces(surfaces + step * np.array([name == label for label in INPUTS]))
            moved = {name: state[name] + step} if name in state else {}
            signals = _signals(aircraft, state | moved)
            rows = [signals[row] for row in ("pdot", "qdot", "rdot", "fy", "fz")]
            flow = [fdm[f"aero/{angle}dot-rad_sec"] for angle in ("beta", "alpha")]
            ends.append(np.array([*rows, *flow]))
        return np.asarray((ends[0] - ends[1]) / (2.0 * PERTURBATION))

    columns = {name: slope(name) for name in (*STATES, *INPUTS)}
    aircraft.set_surfaces(surfaces)
    _signals(aircraft, state)
    derivatives = {
        f"{row}/{name}": float(column[k])
        for k, row in enumerate(MODEL_ROWS)
        for name, column in columns.items()
    }
    # In the model's own term p alpha, alpha is zero where az is; the remainder is the coefficient.
    derivatives["betadot/p"] -= base["fz"] / derivatives["az/alpha"]
    return Linearisation(derivatives, base["airspeed"])


def _signals(aircraft: Aircraft, state: Mapping[str, float]) -> Signals:
    """Return the signals in a state, which has the names of `INITIAL` and JSBSim's units."""
    fdm = aircraft.fdm
    for name, value in state.items():
        fdm[INITIAL[name]] = value
    fdm.run_ic()
    fdm.suspend_integration()  # hold the time
    # the first evaluation yields the rates of the flow angles, which the moments of the second use
    aircraft.step()
    signals = aircraft.step()
    fdm.resume_integration()
    return signals
