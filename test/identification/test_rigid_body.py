# SPDX-License-Identifier: Apache-2.0
"""The coefficients A against the rigid-body equations (9)-(11) of the paper."""

import numpy as np
import pytest

from uav_ident_ros.identification.rigid_body import Inertia, coefficients_from_physics, full_moments
from uav_ident_ros.identification.structure import STRUCTURES


@pytest.mark.parametrize("name", ["baseline", "throttle_coupled", "augmented"])
def test_a_reproduces_the_rigid_body_equations(name: str) -> None:
    structure = STRUCTURES[name]
    rng = np.random.default_rng(1)
    for _ in range(200):
        # a body of a few masses, whose inertias are therefore possible ones
        masses, arms = rng.uniform(0.1, 2.0, 12), rng.normal(size=(3, 12))
        x, y, z = arms * np.array([[0.5], [0.8], [0.2]])
        moments_of = [y**2 + z**2, x**2 + z**2, x**2 + y**2, x * z]
        body = Inertia(*(float(masses @ squares) for squares in moments_of))
        moments = rng.normal(size=(3, structure.size - 5)) * structure.mask[:, 5:]
        a = coefficients_from_physics(body, moments)
        x, u, force = rng.normal(size=3) * 3.0, rng.normal(size=4), rng.normal(size=2) * 5.0
        f = structure.regressor(x, u, force)
        p, q, r = x
        pdot, qdot, rdot = a @ f
        # Equation (9) of the paper, as printed (with pdot Ix for the misprinted p Ix).
        left = [
            pdot * body.ix - rdot * body.ixz + q * r * (body.iz - body.iy) - p * q * body.ixz,
            qdot * body.iy + p * r * (body.ix - body.iz) + (p**2 - r**2) * body.ixz,
            rdot * body.iz - pdot * body.ixz + p * q * (body.iy - body.ix) + q * r * body.ixz,
        ]
        right = moments @ f[5:]
        scale = np.abs(moments * f[5:]).sum() + np.abs(left).max()
        np.testing.assert_allclose(left, right, rtol=0, atol=1e-12 * scale)


def test_impossible_inertias_and_unknown_derivatives_are_refused() -> None:
    with pytest.raises(ValueError, match="not positive definite"):
        Inertia(1.0, 1.0, 1.0, 1.2)
    with pytest.raises(ValueError, match="'l_flap' is no moment derivative"):
        full_moments(STRUCTURES["baseline"], l_flap=1.0)
