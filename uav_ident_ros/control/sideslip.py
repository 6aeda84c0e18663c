# SPDX-License-Identifier: Apache-2.0
"""Rolling by sideslip, for an aircraft whose ailerons are lost or jammed.

The rudder's direct roll moment is small, and often of the wrong sign. A held rudder yaws the
aircraft into a sideslip, whose dihedral effect rolls most aeroplanes. With the yaw rate ``r``
beyond the coordinated one,

    beta' = -r,    pdot = L beta,    L = L_beta - L_dr N_beta / N_dr

(the last term is the rudder that holds the sideslip). A missing roll acceleration thus commands the
yaw rate ``-k missing / L``. The law is incremental: the cause of the roll need not be known.

It sacrifices the yaw axis, and is therefore used only where the aircraft would roll over. With an
aileron lost or jammed near its trim, the other axes remain controlled.
"""

import math

from uav_ident_ros.client import Coefficients

SIDESLIP_RATE = 2.0
"""k: rate at which the sideslip builds up, 1/s: that of the yaw loop."""

LARGEST_YAW_RATE = 0.3
"""Largest yaw rate commanded, rad/s."""

LARGEST_BANK = math.pi / 4.0
"""Bank beyond which an aeroplane counts as upset, rad (ICAO Doc 10011, 2014). Below it the law is
not used."""

FORESIGHT = 3.0
"""Time over which the bank is predicted, s: the time in which a sideslip stops a roll. With one or
two seconds a small aircraft with a jammed aileron is upset first."""


def rolls_over(
    bank: float,  # rad
    p: float,  # Roll rate, rad/s
    acceleration: float,  # Its derivative, rad/s^2
    damping: float,  # L_p, 1/s
) -> bool:
    """Return whether an aircraft without ailerons will exceed `LARGEST_BANK` within `FORESIGHT`.

    The damped roll settles at the rate ``p - p' / L_p``, with the time constant ``-1 / L_p``.
    The roll rate before a failure decays; that of a jammed aileron builds up.
    """
    if damping >= 0.0:
        return abs(bank + FORESIGHT * p) > LARGEST_BANK
    settled = p - acceleration / damping
    return abs(bank + (settled - p) / damping + FORESIGHT * settled) > LARGEST_BANK


def yaw_for_roll(coefficients: Coefficients) -> float:
    """Return the yaw rate per missing roll acceleration, s; 0 without dihedral effect."""
    structure = coefficients.structure
    if not structure.has_flow:
        return 0.0
    l_beta, l_dr, n_beta, n_dr = (
        float(coefficients.values[structure.index(f"{row}/{column}")])
        for row in ("pdot", "rdot")
        for column in ("beta", "dr")
    )
    if n_dr == 0.0 or n_beta <= 0.0:
        return 0.0  # no rudder, or no weathercock stability: the sideslip would diverge
    effect = l_beta - l_dr * n_beta / n_dr
    return -SIDESLIP_RATE / effect if effect < 0.0 else 0.0
