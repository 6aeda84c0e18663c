# SPDX-License-Identifier: Apache-2.0
"""Rolling by sideslip, for an aircraft whose ailerons are lost or jammed.

A rudder rolls little by itself, and at first often the wrong way. Held, it yaws the aircraft into
a sideslip, and that rolls it: by the dihedral, most aeroplanes can be banked so. With the yaw
rate ``r`` beyond the coordinated one,

    beta' = -r,    pdot = L beta,    L = L_beta - L_dr N_beta / N_dr

(the rudder that holds the sideslip counts, too), a roll acceleration that is missing asks for the
yaw rate ``-k missing / L``. It is incremental: what jams the roll need not be known.

The price is the yaw axis, so it is paid only where the aircraft would roll over: an aileron that is
lost, or jammed near its trim, leaves the other axes whole.
"""

import math

from uav_ident_ros.client import Coefficients

SIDESLIP_RATE = 2.0
"""k: how fast the sideslip is built up, 1/s: as fast as the yaw loop."""

LARGEST_YAW_RATE = 0.3
"""Yaw rate that is asked for at most, rad/s."""

LARGEST_BANK = math.pi / 4.0
"""Bank beyond which an aeroplane counts as upset, rad (ICAO Doc 10011, 2014): nothing is done as
long as it stays below."""

FORESIGHT = 3.0
"""Time ahead in which that bank must not be reached, s: what it takes to stop a roll by a sideslip.
With one or two seconds a small aircraft whose aileron jams loses its attitude first."""


def rolls_over(
    bank: float,  # rad
    p: float,  # Roll rate, rad/s
    acceleration: float,  # Its derivative, rad/s^2
    damping: float,  # L_p, 1/s
) -> bool:
    """Say whether an aircraft without ailerons comes to bank beyond what it is to bank.

    Its roll is damped: it settles at ``p - p' / L_p``, with ``1 / -L_p`` as its time constant. What
    it rolled when its aileron broke stops by itself; what a jammed one makes of it has just begun.
    """
    if damping >= 0.0:
        return abs(bank + FORESIGHT * p) > LARGEST_BANK
    settled = p - acceleration / damping
    return abs(bank + (settled - p) / damping + FORESIGHT * settled) > LARGEST_BANK


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
