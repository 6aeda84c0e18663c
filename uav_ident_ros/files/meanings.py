# SPDX-License-Identifier: Apache-2.0
"""Meaning of each coefficient in flight mechanics, in words.

The names follow Etkin and Reid, Dynamics of Flight, 1996. Each product of rates has the moments of
inertia that cause it.
"""

from collections.abc import Mapping

INPUT_WORDS: Mapping[str, str] = {
    "de": "elevator",
    "dr": "rudder",
    "da": "aileron",
    "dth": "throttle",
}
"""Names of the inputs of an aircraft with wings."""

AXIS_INPUT_WORDS: Mapping[str, str] = {
    "de": "pitch input",
    "dr": "yaw input",
    "da": "roll input",
    "dth": "throttle",
}
"""Names of the inputs of a multirotor, which has no surfaces."""

AXIS_WORDS: Mapping[str, str] = {"pdot": "roll", "qdot": "pitch", "rdot": "yaw"}
"""Axes of the moment rows."""

MEANINGS: Mapping[str, str] = {
    "pdot/pq": "inertial coupling into roll (Ixz)",
    "pdot/qr": "inertial coupling into roll (Iy - Iz)",
    "pdot/p": "roll damping",
    "pdot/r": "roll due to yaw rate",
    "pdot/dr": "roll due to rudder",
    "pdot/da": "aileron power",
    "pdot/dth": "roll due to throttle (torque)",
    "pdot/1": "roll offset of the trim",
    "pdot/ay": "dihedral effect (ay stands for sideslip)",
    "qdot/pr": "inertial coupling into pitch (Iz - Ix)",
    "qdot/pp": "inertial coupling into pitch (-Ixz)",
    "qdot/rr": "inertial coupling into pitch (Ixz)",
    "qdot/q": "pitch damping",
    "qdot/de": "elevator power",
    "qdot/dth": "pitch due to throttle (thrust line)",
    "qdot/1": "pitch offset of the trim",
    "qdot/az": "pitch stiffness (az stands for angle of attack)",
    "rdot/pq": "inertial coupling into yaw (Ix - Iy)",
    "rdot/qr": "inertial coupling into yaw (-Ixz)",
    "rdot/p": "yaw due to roll rate",
    "rdot/r": "yaw damping",
    "rdot/dr": "rudder power",
    "rdot/da": "adverse yaw (yaw due to aileron)",
    "rdot/dth": "yaw due to throttle (slipstream)",
    "rdot/1": "yaw offset of the trim",
    "rdot/ay": "weathercock stability (ay stands for sideslip)",
    "pdot/beta": "dihedral effect",
    "qdot/alpha": "pitch stiffness",
    "rdot/beta": "weathercock stability",
    "ay/p": "side force due to roll rate",
    "ay/r": "side force due to yaw rate",
    "ay/dr": "side force due to rudder",
    "ay/beta": "side force due to sideslip",
    "az/de": "lift due to elevator",
    "az/alpha": "lift slope",
    "betadot/p": "angle of attack of the roll axis without lift",
    "betadot/1": "bias of the sideslip's kinematics",
    "alphadot/1": "bias of the angle of attack's kinematics",
}
"""Meanings of the coefficients of all structures."""
