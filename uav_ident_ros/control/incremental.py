# SPDX-License-Identifier: Apache-2.0
"""Incremental nonlinear dynamic inversion (INDI): measured acceleration instead of a model.

    u = u_f + B^-1 (reference' + K (reference - x) - xdot_f)

xdot_f is the angular acceleration that the gyro shows, u_f the inputs that made it: both pass the
same filter, and the inputs are delayed as the surfaces are, so that they belong together. What the
aircraft does by itself, by its trim or by a gust is in xdot_f; of the model the control
derivatives B are needed, and they may be wrong: the loop converges for any true effect between
none and twice B, at a speed of their ratio.

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
"""For a light aircraft at 100 Hz, 20 ms from sample to surface."""


@dataclass
class IncrementalLaw:
    """INDI rate control."""

    limits: FloatArray  # (2, 4) Least and largest de, dr, da, dth, deviations from trim
    scale: FloatArray  # (3,) Worth of each axis, rad/s^2: see `allocate`
    gains: Gains = GAINS  # How fast

    def restart(self, x: FloatArray, reference: FloatArray, acting: FloatArray) -> None:
        """Forget the past: the first sample, or one after a gap. Parameters as of `update`."""
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
        # Yaw rate that makes up for missing roll acceleration, s: see `sideslip`
        yaw_for_roll: float = 0.0,
    ) -> FloatArray:
        """Return de, dr, da, dth, deviations from trim."""
        self._rates.update(x, dt)
        self._inputs.update(acting, dt)
        missing = self._reference.wanted(dt, x, reference) - self._rates.slope
        # no more than the rudder can start at once: at its stops it lags, and the Dutch roll grows
        most = min(LARGEST_YAW_RATE, self.scale[2] / self.gains.rate[2])
        missing[2] += self.gains.rate[2] * np.clip(yaw_for_roll * missing[0], -most, most)
        return allocate(effect, effect @ self._inputs.value + missing, self.limits, self.scale)
