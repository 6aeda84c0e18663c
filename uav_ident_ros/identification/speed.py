# SPDX-License-Identifier: Apache-2.0
"""Speed scaling: coefficients that hold across flight speeds.

With constant aerodynamic coefficients, moments grow with the dynamic pressure, thus with V^2 of the
airspeed V. So do control derivatives, and a constant moment, which is that of an input off its
trim. Damping grows with V, since the flow angle that a rate causes falls with V. The estimator uses
regressors scaled by V / V_ref and its square, and thus identifies the coefficients at V_ref.
Published coefficients hold at the speed flown.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.samples import NS, SampleBuffer
from uav_ident_ros.identification.scales import RESPONSE_TIME
from uav_ident_ros.identification.settings import AirspeedSettings, Settings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    LAST_COLUMNS,
    OWN_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    STRUCTURES,
    FloatArray,
    Structure,
)

LARGEST_RATIO = 3.0
"""Largest ratio of airspeed and reference, or its inverse, at which the scaling holds: at lower
speed the flow separates, at higher speed the measurement is wrong."""

SILENCE = f"no airspeed has arrived in the last {RESPONSE_TIME:g} s"
"""Reason not to learn, and not to use the coefficients."""


def slowest(settings: AirspeedSettings) -> float:
    """Return the lowest airspeed at which the scaling holds, m/s."""
    return settings.reference / LARGEST_RATIO


def unmeasured(settings: Settings) -> str:
    """Return the problem if the airspeed is neither measured nor configured; else empty."""
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
        self._reference, self._slowest = settings.reference, slowest(settings)
        self._power: FloatArray = np.zeros(structure.mask.shape)
        self._power[:, RATE_COLUMNS] = 1.0
        self._power[:, INPUT_COLUMNS] = 2.0
        self._power[: len(ROWS)][structure.constants[: len(ROWS)]] = 2.0
        self._power[: len(ROWS), OWN_COLUMNS] = [own.power for own in structure.own]
        if structure.has_flow:
            self._power[:, LAST_COLUMNS] = 2.0
            # so that its product with the slope of ay grows with V, as the other columns of p
            self._power[structure.row_labels.index("betadot"), RATE_COLUMNS] = -1.0
        self.known = not self.enabled  # Whether the scale holds at the airspeed flown
        self.scale: FloatArray = np.ones_like(self._power)  # (R, n) Factor of each coefficient
        self.newest: float | None = None  # m/s
        self.restart()

    def restart(self) -> None:
        """Begin a new time base: no airspeed has arrived since."""
        self.airspeed.clear()
        # Problem if an airspeed was measured, but none lately; empty if there is none
        self.silence = "" if self.newest is None else SILENCE
        # Whether the scale is valid: no airspeed is measured, or it is high enough and up to date
        self.believed = self.newest is None

    def update(self, t_ns: int) -> None:
        """Update the scale with the newest airspeed in use at the tick `t_ns`."""
        stamps = self.airspeed.t
        if self.enabled and len(stamps):
            self.newest = float(self.airspeed.v[-1, 0])
            ratio = self.newest / self._reference
            ratio = min(max(ratio, 1.0 / LARGEST_RATIO), LARGEST_RATIO)
            self.scale = ratio**self._power
            self.known = True
            self.airspeed.trim(t_ns)
        silent = not len(stamps) or (t_ns - stamps[-1]) * NS > RESPONSE_TIME
        if self.newest is not None:
            self.silence = SILENCE if silent else ""
            self.believed = not silent and self.newest >= self._slowest
