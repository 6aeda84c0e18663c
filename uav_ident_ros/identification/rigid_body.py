# SPDX-License-Identifier: Apache-2.0
"""Coefficient matrix A from inertias and aerodynamic derivatives.

The equations after (12) of Salman et al. 2006, derived from the rigid-body
equations (9) and the moment model (11), (15).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import RATE_COLUMNS, FloatArray, Structure

FIRST_MOMENT_COLUMN = RATE_COLUMNS.start
"""First column of the moment derivatives; the columns before it are inertia ratios."""


@dataclass(frozen=True)
class Inertia:
    """Moments of inertia of a body symmetric about its xz plane, kg m^2.

    Raises
    ------
    ValueError
        If the inertia tensor is not positive definite.
    """

    ix: float
    iy: float
    iz: float
    ixz: float = 0.0

    def __post_init__(self) -> None:
        if not (min(self.ix, self.iy, self.iz) > 0.0 and self.ix * self.iz > self.ixz**2):
            raise ValueError(
                f"inertia ({self.ix}, {self.iy}, {self.iz}, {self.ixz}) kg m^2 is not positive "
                "definite: ix, iy, iz > 0 and ix iz > ixz^2 are required"
            )

    def tensor(self) -> FloatArray:
        """Return the inertia tensor, shape (3, 3), kg m^2."""
        return np.array([[self.ix, 0.0, -self.ixz], [0.0, self.iy, 0.0], [-self.ixz, 0.0, self.iz]])


def product_coefficients(inertia: Inertia) -> FloatArray:
    """Return the coefficients of pq, qr, pr, p^2, r^2, shape (3, 5): A11 ... A32 after (12)."""
    ix, iy, iz, ixz = inertia.ix, inertia.iy, inertia.iz, inertia.ixz
    det = ix * iz - ixz**2
    a = np.zeros((3, 5))
    a[0, 0] = ixz * (ix - iy + iz) / det
    a[0, 1] = (iz * (iy - iz) - ixz**2) / det
    a[1, 2] = (iz - ix) / iy
    a[1, 3] = -ixz / iy
    a[1, 4] = ixz / iy
    a[2, 0] = (ix * (ix - iy) + ixz**2) / det
    a[2, 1] = -a[0, 0]
    return a


def coefficients_from_physics(
    inertia: Inertia,
    # (3, n - 5) Derivatives of the moments L, M, N (N m) with respect to p, q, r (rad/s), de, dr,
    # da, dth, and, in the augmented structure, 1, ay, az: eqs. (11) and (15)
    moments: FloatArray,
) -> FloatArray:
    """Return the coefficients A, (3, n), in 1/s^2 per unit of each regressor."""
    moments = np.asarray(moments, dtype=np.float64)
    return np.hstack([product_coefficients(inertia), np.linalg.solve(inertia.tensor(), moments)])


def full_moments(structure: Structure, **derivatives: float) -> FloatArray:
    """Return moment derivatives as the (3, n - 5) array of `coefficients_from_physics`.

    A name is ``l_p``, ``m_de``, ``n_dr``: the moment (l, m, n), then the regressor; N m per unit.

    Raises
    ------
    ValueError
        If a name is not a derivative of the structure.
    """
    labels = structure.regressors[FIRST_MOMENT_COLUMN:]
    moments = np.zeros((3, len(labels)))
    for name, value in derivatives.items():
        moment, _, label = name.partition("_")
        if moment not in ("l", "m", "n") or label not in labels:
            raise ValueError(
                f"'{name}' is no moment derivative of structure '{structure.name}': "
                f"l_, m_ or n_ followed by one of {', '.join(labels)}"
            )
        moments["lmn".index(moment), labels.index(label)] = value
    return moments
