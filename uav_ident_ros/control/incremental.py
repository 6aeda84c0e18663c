# SPDX-License-Identifier: Apache-2.0
"""Incremental nonlinear dynamic inversion (INDI): measured accelerations replace the model.

    u = u_f + B^-1 (reference' + K (reference - x) - xdot_f)

xdot_f is the angular acceleration from the gyro, u_f the inputs that caused it. Both pass the same
filter, and the inputs have the delay of the surfaces, so that they are synchronous. xdot_f contains
the aircraft's own dynamics, trim and gusts. Of the model only the control derivatives B are needed.
They may be wrong: the loop converges for any true effect between zero and twice B, at a rate
proportional to their ratio.

S. Sieberling, Q. P. Chu, J. A. Mulder, "Robust flight control using incremental nonlinear dynamic
inversion and angular acceleration prediction", JGCD 33(6), 2010; E. J. J. Smeur, Q. Chu,
G. C. H. E. de Croon, "Adaptive incremental nonlinear dynamic inversion for attitude control of
micro air vehicles", JGCD 39(3), 2016.
"""

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.control.allocation import allocate
from uav_ident_ros.control.reference import Gains, ReferenceModel, Smoother
from uav_ident_ros.control.sideslip import LARGEST_YAW_RATE
from uav_ident_ros.identification.structure import FloatArray

GAINS = Gains(rate=(5.0, 4.0, 2.0), bandwidth=20.0)
"""Gains for a light aircraft at 100 Hz with a delay of 20 ms."""


@dataclass
class IncrementalLaw:
    """INDI rate control."""

    limits: FloatArray  # (2, 4) Lower and upper limits of de, dr, da, dth, deviations from trim
    scale: FloatArray  # (3,) Unit of the acceleration of each axis, rad/s^2: see `allocate`
    gains: Gains = GAINS

    def restart(self, x: FloatArray, reference: FloatArray, acting: FloatArray) -> None:
        """Reset the filters at the first sample, or after a gap. Parameters as of `update`."""
        self._rates = Smoother(self.gains.bandwidth, x)
        self._inputs = Smoother(self.gains.bandwidth, acting)
        self._reference = ReferenceModel(self.gains, reference)

    def update(
        self,
        dt: float,  # Time since the last call, s
        effect: FloatArray,  # (3, 4) B, control derivatives, rad/s^2 per unit
        x: FloatArray,  # x, reference: (3,) Measured and wanted p, q, r, rad/s, FRD
        reference: FloatArray,
        acting: FloatArray,  # (4,) Inputs since the last call: those commanded one delay before it
        # Yaw rate per missing roll acceleration, s: see `sideslip`
        yaw_for_roll: float = 0.0,
    ) -> FloatArray:
        """Return de, dr, da, dth, deviations from trim."""
        self._rates.update(x, dt)
        self._inputs.update(acting, dt)
        missing = self._reference.wanted(dt, x, reference) - self._rates.slope
        # limited to the rudder's authority: at its stops it lags and destabilises the Dutch roll
        most = min(LARGEST_YAW_RATE, self.scale[2] / self.gains.rate[2])
        missing[2] += self.gains.rate[2] * np.clip(yaw_for_roll * missing[0], -most, most)
        return allocate(effect, effect @ self._inputs.value + missing, self.limits, self.scale)
