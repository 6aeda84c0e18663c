# SPDX-License-Identifier: Apache-2.0
"""Plants of the paper's structure, by name."""

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.rigid_body import (
    Inertia,
    coefficients_from_physics,
    full_moments,
)
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.errors import SimulationError


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A plant ``xdot = A f(x, u)``."""

    name: str  # Its name
    structure: str  # Structure of A
    coefficients: FloatArray  # (3, n) A, SI units
    inertia: Inertia | None = None  # Its inertias, kg m^2, if A came from them


def _small_uav() -> Vehicle:
    """Propeller aircraft of 13 kg: roll, pitch, yaw damping of about 10, 6 and 2 1/s."""
    inertia = Inertia(ix=0.8244, iy=1.135, iz=1.759, ixz=0.1204)
    structure = STRUCTURES["throttle_coupled"]
    moments = full_moments(
        structure,
        l_p=-8.2, l_r=1.5, l_dr=2.7, l_da=49.6, l_dth=0.7,
        m_q=-6.8, m_de=-45.0, m_dth=-1.0,
        n_p=0.3, n_r=-3.7, n_dr=-21.3, n_da=-9.9, n_dth=-1.0,
    )  # fmt: skip
    return Vehicle(
        "small_uav", structure.name, coefficients_from_physics(inertia, moments), inertia
    )


# A of Section 4, as printed; columns pq qr pr p^2 r^2 p q r de dr da dth.
_PRINTED = (
    (0.0010, 0.0107, 0.0, 0.0, 0.0, -0.1361, 0.0, 0.0111, 0.0, 0.0181, 0.0030, 0.0014),
    (0.0, 0.0, 0.0107, -0.0103, 0.0103, 0.0, -0.1090, 0.0, 0.0105, 0.0, 0.0, 0.0004),
    (0.0102, 0.0093, 0.0, 0.0, 0.0, 0.0104, 0.0, -0.1032, 0.0, -0.0011, 0.0054, 0.0001),
)


def _paper_printed() -> Vehicle:
    """Return the coefficients that the paper prints, moved from degrees to SI.

    The quadratic columns grow by 180 / pi, the others keep their values. They are no
    rigid body's: A32 is not -A11.
    """
    a = np.array(_PRINTED)
    a[:, :5] *= 180.0 / np.pi
    return Vehicle("paper_printed", "throttle_coupled", a)


_VEHICLES = {"small_uav": _small_uav, "paper_printed": _paper_printed}

VEHICLE_NAMES = tuple(_VEHICLES)
"""Names of the plants."""


def vehicle(name: str) -> Vehicle:
    """Return the plant called `name`.

    Raises
    ------
    SimulationError
        If there is none.
    """
    if name not in _VEHICLES:
        raise SimulationError(f"plant '{name}' is unknown: use one of {', '.join(VEHICLE_NAMES)}")
    return _VEHICLES[name]()


SMALL_UAV_AUTOPILOT = {
    "rate_gain": {"de/q": 0.05, "da/p": -0.03, "dr/r": 0.08},
    "angle_gain": {"de/q": 0.15, "da/p": -0.12},
}
"""Feedback gains (rad per rad/s, rad per rad) that hold the attitude of `small_uav`."""
