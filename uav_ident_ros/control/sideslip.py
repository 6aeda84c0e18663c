# SPDX-License-Identifier: Apache-2.0
"""Rolling by sideslip, for an aircraft whose ailerons are lost or jammed.

A rudder rolls little by itself, and at first often the wrong way. Held, it yaws the aircraft into
a sideslip, and that rolls it: by the dihedral, most aeroplanes can be banked so. With the yaw
rate ``r`` beyond the coordinated one,

    beta' = -r,    pdot = L beta,    L = L_beta - L_dr N_beta / N_dr

(the rudder that holds the sideslip counts, too), a roll acceleration that is missing asks for the
yaw rate ``-k missing / L``. It is incremental: what jams the roll need not be known.
"""

from __future__ import annotations

from uav_ident_ros.client import Coefficients

SIDESLIP_RATE = 2.0
"""k: how fast the sideslip is built up, 1/s: as fast as the yaw loop."""

LARGEST_YAW_RATE = 0.3
"""Yaw rate that is asked for at most, rad/s."""


def yaw_for_roll(coefficients: Coefficients) -> float:
    """Return the yaw rate per missing roll acceleration, s; 0 if sideslip does not roll it."""
    structure = coefficients.structure
    if not structure.has_flow:
        return 0.0
    l_beta, l_dr, n_beta, n_dr = (
        float(coefficients.values[structure.index(f"{row}/{column}")])
        for row in ("pdot", "rdot")
        for column in ("beta", "dr")
    )
    if n_dr == 0.0 or n_beta <= 0.0:
        return 0.0  # no rudder, or no weathercock: a sideslip would not stay what it is
    effect = l_beta - l_dr * n_beta / n_dr
    return -SIDESLIP_RATE / effect if effect < 0.0 else 0.0
