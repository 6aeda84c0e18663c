# SPDX-License-Identifier: Apache-2.0
"""True derivatives of a JSBSim aircraft where it flies: central differences of its accelerations.

Nothing is fitted. JSBSim is put into the state it is in, a little to one side and to the other,
with the surfaces it has, and says what the accelerations are there. Engine speed, fuel and mass
stay; the throttle's derivatives are those at the speed that the engine has, not a second later.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.aircraft import COLUMN, Aircraft, settle

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
    alpha: float  # Angle of attack, rad


def linearise_cruise(
    name: str,  # As in `uav_ident_ros.simulation.airframe`
    speed: float | None = None,  # True airspeed in place of its own, m/s
) -> Linearisation:
    """Linearise an aircraft in steady, calm flight.

    Raises
    ------
    SimulationError
        If it cannot be flown.
    """
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
            rows = [COLUMN[name] for name in ("pdot", "qdot", "rdot", "fy", "fz")]
            flow = [fdm[f"aero/{angle}dot-rad_sec"] for angle in ("beta", "alpha")]
            ends.append(np.append(signals[rows], flow))
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
    derivatives["betadot/p"] -= float(base[COLUMN["fz"]]) / derivatives["az/alpha"]
    return Linearisation(derivatives, float(base[COLUMN["airspeed"]]), float(base[COLUMN["alpha"]]))


def _signals(aircraft: Aircraft, state: Mapping[str, float]) -> FloatArray:
    """`SIGNALS` in a state, SI, shape (21,)."""
    fdm = aircraft.fdm
    for name, value in state.items():
        fdm[name] = value
    fdm.run_ic()
    fdm.suspend_integration()  # no time passes
    # once for the flow angles' rates, which JSBSim's moments may use, and once with them
    aircraft.step()
    signals = aircraft.to_si(np.array(aircraft.step()))
    fdm.resume_integration()
    return signals
