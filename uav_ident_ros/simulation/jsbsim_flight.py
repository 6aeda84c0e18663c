# SPDX-License-Identifier: Apache-2.0
"""Flights of JSBSim aircraft: nonlinear aircraft that nobody here modelled.

JSBSim (LGPL, ``pip install jsbsim``) is a development extra: it is imported when a flight
is flown. One step of JSBSim moves the state first and evaluates controls, forces and
accelerations after, so that what is read after a step belongs to one instant.
"""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.flight import EPOCH_NS, CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import Segment, sample_inputs
from uav_ident_ros.simulation.plant import GRID_TOLERANCE, excited_intervals

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

SETTLING_TIME = 20.0
"""Time on the autopilot before the record begins, s."""

BANK_TIME = 20.0
"""Time of each turn of a banked flight, s, rolled into over `ROLL_TIME`."""

ROLL_TIME = 4.0
"""Time in which the reference of the bank angle changes, s."""

MAX_BANK = 60.0
"""Largest bank angle that the autopilot is asked for, deg."""

TIME_TOLERANCE = 1e-9
"""A change this close to a step happens at it, s."""

LARGEST_UPSET = math.radians(80.0)
"""Roll or pitch angle at which a flight counts as lost, rad."""

_SURFACES = (
    "fcs/elevator-pos-rad",
    "fcs/rudder-pos-rad",
    "fcs/left-aileron-pos-rad",
    "fcs/throttle-pos-norm",
)
_COMMANDS = ("fcs/elevator-cmd-norm", "fcs/rudder-cmd-norm", "fcs/aileron-cmd-norm")
_TRIMS = ("fcs/pitch-trim-cmd-norm", "fcs/yaw-trim-cmd-norm", "fcs/roll-trim-cmd-norm")

COMMAND_POINTS = (-1.0, 0.0, 1.0)
"""Commands between which a surface's travel is linear."""

# What is read after every step, and the factor that makes it SI.
_SIGNALS = {
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
    "altitude": ("position/h-sl-ft", FOOT),
    "elevator": (_SURFACES[0], 1.0),
    "rudder": (_SURFACES[1], 1.0),
    "aileron": (_SURFACES[2], 1.0),
    "throttle": (_SURFACES[3], 1.0),
}
_COLUMN = {name: i for i, name in enumerate(_SIGNALS)}


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


@dataclass(frozen=True)
class AircraftFlight:
    """Everything that defines a flight of a JSBSim aircraft.

    Parameters
    ----------
    aircraft : str
        One of `AIRFRAMES`.
    segments : sequence of Segment
        Excitation, added to the autopilot's commands.
    duration : float
        Length of the record, s.
    rate : float
        Rate of the simulation and of the noise-free samples, Hz.
    actuator_rate : float
        Rate of the commands, Hz; each is held until the next.
    delay : float
        From recorded command to surface, s.
    bank : float
        Bank angle of alternating turns, deg; 0 for level flight.
    turbulence : int
        JSBSim's MIL-F-8785C severity, 0 (calm) to 7.
    changes : tuple of CoefficientChange
        From a time on, an input (``de`` and so on) has its effect about trim multiplied.
    seed : int
        Seed of the turbulence.
    """

    aircraft: str
    segments: Sequence[Segment]
    duration: float
    rate: float = 1000.0
    actuator_rate: float = 100.0
    delay: float = 0.0
    bank: float = 0.0
    turbulence: int = 0
    changes: tuple[CoefficientChange, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if self.aircraft not in AIRFRAMES:
            raise SimulationError(
                f"JSBSim aircraft '{self.aircraft}' is not set up here: use one of "
                f"{', '.join(AIRFRAMES)}"
            )
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
        for target in _COMMANDS:
            fdm[target] = command
        fdm.run()
        out[:, i] = [fdm[surface] for surface in _SURFACES[:3]]
    return out


class _Aircraft:
    """JSBSim aircraft in trimmed flight: takes surfaces, gives signals."""

    def __init__(self, spec: AircraftFlight, airframe: Airframe) -> None:
        self.ranges = _surface_ranges(spec.aircraft, spec.rate)
        self.fdm = _load(spec.aircraft, spec.rate)
        self.airframe = airframe
        self._trim(spec)
        nodes = self.fdm.get_property_manager()
        self._read = [nodes.get_node(name) for name, _ in _SIGNALS.values()]
        self._scale = np.array([scale for _, scale in _SIGNALS.values()])
        self._command = [nodes.get_node(name) for name in _COMMANDS]
        engines = int(self.fdm["propulsion/engine-count"]) if self._counts_engines() else 1
        suffixes = [""] + [f"[{i}]" for i in range(1, engines)]
        self._throttle = [nodes.get_node(f"fcs/throttle-cmd-norm{s}") for s in suffixes]
        self.surfaces = np.array([self.fdm[s] for s in _SURFACES])
        self.mass = self.fdm["inertia/mass-slugs"]

    def _counts_engines(self) -> bool:
        return bool(self.fdm.get_property_manager().hasNode("propulsion/engine-count"))

    def _trim(self, spec: AircraftFlight) -> None:
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
            raise SimulationError(f"JSBSim cannot trim '{spec.aircraft}': {error}") from None
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
        """Move on by one step; the signals in the order of `_SIGNALS`, in JSBSim's units."""
        self.fdm.run()
        return [node.get_double_value() for node in self._read]

    def to_si(self, record: FloatArray) -> FloatArray:
        """Signals in SI units; specific force in place of the forces."""
        record = record * self._scale
        record[:, 6:9] *= FOOT / self.mass
        return record


class _Autopilot:
    """Attitude, altitude and speed hold; low gains, so that the excitation comes through."""

    def __init__(self, airframe: Airframe, trim: FloatArray, pitch: float) -> None:
        self.airframe, self.trim, self.pitch = airframe, trim, pitch

    def surfaces(self, signals: Sequence[float], climb: float, bank: float) -> FloatArray:
        """Elevator, rudder, aileron, throttle from the signals (JSBSim's units)."""
        a = self.airframe
        altitude = signals[_COLUMN["altitude"]] * FOOT
        speed = signals[_COLUMN["airspeed"]] * FOOT
        reference = self.pitch + a.altitude_gain * (a.altitude - altitude) - a.climb_gain * climb
        pitch_error = signals[_COLUMN["pitch"]] - reference
        roll_error = signals[_COLUMN["roll"]] - bank
        correction = np.array(
            [
                a.pitch_gain * pitch_error + a.pitch_damping * signals[_COLUMN["q"]],
                0.0,
                -a.roll_gain * roll_error,
                a.speed_gain * (a.speed - speed),
            ]
        )
        return np.asarray(self.trim + correction)


def _bank_reference(spec: AircraftFlight, t: float) -> float:
    """Bank angle of alternating turns, rad: right, left, right, ..."""
    if spec.bank == 0.0 or t < 0.0:
        return 0.0
    turn, into = divmod(t, BANK_TIME)
    side = 1.0 if turn % 2 == 0 else -1.0
    last = 0.0 if turn == 0 else -side
    blend = min(1.0, into / ROLL_TIME)
    return math.radians(spec.bank) * (last + (side - last) * blend)


def _effect(spec: AircraftFlight, t: float) -> FloatArray:
    """Effect of each input about trim at time t, shape (4,)."""
    effect = np.ones(len(INPUTS))
    for change in spec.changes:
        if change.time <= t + TIME_TOLERANCE:
            for name, factor in change.factors.items():
                effect[INPUTS.index(name)] *= factor
    return effect


def _whole(value: float, what: str) -> int:
    if abs(value - round(value)) > GRID_TOLERANCE * max(1.0, value):
        raise SimulationError(f"{what} is no whole number of simulation steps")
    return round(value)


def fly(spec: AircraftFlight, name: str = "") -> Flight:
    """Fly a JSBSim aircraft on a simple autopilot.

    Parameters
    ----------
    spec : AircraftFlight
        The flight.
    name : str
        Name of the result; the aircraft's by default.

    Raises
    ------
    SimulationError
        If JSBSim is not installed, or the aircraft cannot be trimmed or is lost.
    """
    airframe = AIRFRAMES[spec.aircraft]
    aircraft = _Aircraft(spec, airframe)
    every = _whole(spec.rate / spec.actuator_rate, f"actuator rate {spec.actuator_rate:g} Hz")
    delay = _whole(spec.delay * spec.rate, f"delay {spec.delay:g} s")
    first = -round(SETTLING_TIME * spec.actuator_rate) * every
    last = math.floor(spec.duration * spec.rate + GRID_TOLERANCE)
    steps = np.arange(first, last + 1)
    command_steps = steps[::every]
    excitation = sample_inputs(spec.segments, command_steps / spec.rate)

    signals = aircraft.step()
    autopilot = _Autopilot(airframe, aircraft.surfaces, signals[_COLUMN["pitch"]])
    commands = np.tile(aircraft.surfaces, (len(command_steps), 1))
    trim, record, altitude = aircraft.surfaces, [], signals[_COLUMN["altitude"]] * FOOT
    acting, last_effect = -1, _effect(spec, -math.inf)
    for k, step in enumerate(steps.tolist()):
        t = step / spec.rate
        if step == 0:
            _start_turbulence(aircraft.fdm, spec)
            trim = commands[max(0, k // every - 1)]
        if k % every == 0:
            above = signals[_COLUMN["altitude"]] * FOOT
            climb, altitude = (above - altitude) * spec.actuator_rate, above
            wanted = autopilot.surfaces(signals, climb, _bank_reference(spec, t))
            commands[k // every] = aircraft.clip(wanted + excitation[k // every])
            _check_attitude(spec, signals, t)
        due = max(0, k - delay) // every
        effect = _effect(spec, t)
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


def _start_turbulence(fdm: Any, spec: AircraftFlight) -> None:
    if spec.turbulence:
        fdm["simulation/randomseed"] = spec.seed
        fdm["atmosphere/randomseed"] = spec.seed
        fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = WIND_AT_20_FEET
        fdm["atmosphere/turbulence/milspec/severity"] = spec.turbulence
        fdm["atmosphere/turb-type"] = TURBULENCE_TUSTIN


def _check_attitude(spec: AircraftFlight, signals: Sequence[float], t: float) -> None:
    angles = (signals[_COLUMN["roll"]], signals[_COLUMN["pitch"]])
    if not all(abs(angle) < LARGEST_UPSET for angle in angles):  # NaN fails too
        raise SimulationError(
            f"JSBSim aircraft '{spec.aircraft}' is lost at {t:.1f} s: use smaller amplitudes, "
            "less bank or less turbulence"
        )


def _make_flight(
    spec: AircraftFlight,
    name: str,
    record: FloatArray,
    command_steps: Any,
    commands: FloatArray,
    trim: FloatArray,
) -> Flight:
    def nanoseconds(steps: Any) -> Any:
        return EPOCH_NS + np.rint(steps * (1e9 / spec.rate)).astype(np.int64)

    extra = {key: record[:, _COLUMN[key]] for key in ("alpha", "beta", "roll", "pitch", "altitude")}
    surfaces = [_COLUMN[key] for key in ("elevator", "rudder", "aileron", "throttle")]
    return Flight(
        name=name or spec.aircraft,
        t_ns=nanoseconds(np.arange(len(record))),
        rates=record[:, 0:3],
        angular_acceleration=record[:, 3:6],
        specific_force=record[:, 6:9],
        actuator_t_ns=nanoseconds(command_steps),
        inputs=commands - trim,
        trim=np.array(trim),
        delay=spec.delay,
        changes=spec.changes,
        local_truth=dict(AIRFRAMES[spec.aircraft].local_truth),
        excitation=excited_intervals(spec.segments, spec.duration),
        airspeed=record[:, _COLUMN["airspeed"]],
        extra={**extra, "surfaces": record[:, surfaces]},
    )
