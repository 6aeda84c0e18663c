# SPDX-License-Identifier: Apache-2.0
"""Speed scaling: coefficients that hold across flight speeds.

At constant lift coefficients a damping derivative grows with the airspeed V and a control
derivative with V^2 (dynamic pressure times the angle that the rate makes, or the deflection), and
so does a constant moment: it is what an input does that is away from its trim.
The estimator sees regressors scaled by V / V_ref and its square, so that it identifies the
coefficients at the reference speed; what is published is valid at the speed flown.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.samples import SampleBuffer
from uav_ident_ros.identification.settings import AirspeedSettings, Settings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    LAST_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    STRUCTURES,
    FloatArray,
    Structure,
)

LARGEST_RATIO = 3.0
"""Airspeed relative to the reference, and its inverse, beyond which the law is not believed:
below it flow separates, above it something else is wrong."""


def slowest(settings: AirspeedSettings) -> float:
    """Return the airspeed, m/s, below which the law is not believed."""
    return settings.reference / LARGEST_RATIO


def unmeasured(settings: Settings) -> str:
    """Return what is wrong where nobody has told how fast the aircraft flies; empty if one has."""
    airspeed, default = settings.airspeed, AirspeedSettings().reference
    needed = STRUCTURES[settings.structure].has_flow
    if airspeed.type or airspeed.reference != default or not needed:
        return ""
    return (
        f"no airspeed is measured, and 'airspeed.reference' is the default, {default:g} m/s: set "
        "it to the speed flown, or set 'airspeed.type' (a reference 2.6 times too low costs 30 % "
        "of qdot/de)"
    )


class SpeedScaling:
    """Scale of each regressor at the airspeed flown."""

    def __init__(self, settings: AirspeedSettings, structure: Structure) -> None:
        self.enabled = settings.type != ""
        self.airspeed = SampleBuffer(1)  # True airspeed, m/s
        self._reference = settings.reference
        self._power: FloatArray = np.zeros(structure.mask.shape)
        self._power[:, RATE_COLUMNS] = 1.0
        self._power[:, INPUT_COLUMNS] = 2.0
        self._power[: len(ROWS)][structure.constants[: len(ROWS)]] = 2.0
        if structure.has_flow:
            self._power[:, LAST_COLUMNS] = 2.0
            # so that the product with the slope of ay grows as p does in the other rows
            self._power[structure.row_labels.index("betadot"), RATE_COLUMNS] = -1.0
        self.known = not self.enabled  # Whether the scale is that of the airspeed flown
        self.scale: FloatArray = np.ones_like(self._power)  # (R, n) Factor of each coefficient
        self.newest: float | None = None  # m/s

    def update(self, t_ns: int) -> None:
        """Take the newest airspeed in use at `t_ns`."""
        if self.enabled and len(self.airspeed.t):
            self.newest = float(self.airspeed.v[-1, 0])
            ratio = self.newest / self._reference
            ratio = min(max(ratio, 1.0 / LARGEST_RATIO), LARGEST_RATIO)
            self.scale = ratio**self._power
            self.known = True
            self.airspeed.trim(t_ns)
