# SPDX-License-Identifier: Apache-2.0
"""Model-based inversion with a disturbance observer.

    u = B^-1 (reference' + K (reference - x) - d - A f(x, 0))

d is the disturbance: trim, gusts, the flow angles, errors of A and B. An observer estimates it from
the rates and the delayed commands, without differentiating::

    xhat' = A f(x, u) + d + 2 w (x - xhat)        d' = w^2 (x - xhat)

The loop thus has integral action: a wrong model makes it slow, not unstable.
"""

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.control.allocation import allocate
from uav_ident_ros.control.reference import Gains, ReferenceModel
from uav_ident_ros.identification.structure import FloatArray

GAINS = Gains(rate=(5.0, 4.0, 2.0), bandwidth=8.0)
"""Gains for a light aircraft at 100 Hz with a delay of 20 ms."""

OBSERVER = np.array([1.0, 1.0, 0.5])
"""Bandwidth of the observer by axis, over that of the gains: yaw is the slower loop."""


@dataclass
class InversionLaw:
    """Rate control by inversion of the identified model; fields as of `IncrementalLaw`."""

    limits: FloatArray
    scale: FloatArray
    gains: Gains = GAINS

    def restart(
        self, model: AttitudeModel, effect: FloatArray, x: FloatArray, reference: FloatArray
    ) -> None:
        """Reset the observer at the first sample, or after a gap."""
        self._model, self._effect = model, effect
        self._xhat, self._disturbance = x, np.zeros(3)
        self._reference = ReferenceModel(self.gains, reference)

    def update(
        self,
        dt: float,
        model: AttitudeModel,
        effect: FloatArray,
        x: FloatArray,
        reference: FloatArray,
        acting: FloatArray,
    ) -> FloatArray:
        """Return de, dr, da, dth; parameters as of `IncrementalLaw.update`, and the model."""
        unforced = without_flow(model, x)
        known = unforced + effect @ acting
        # bumpless transfer to a new model: the sum of model and disturbance stays
        before = without_flow(self._model, x) + self._effect @ acting
        self._disturbance = self._disturbance + before - known
        self._model, self._effect = model, effect
        error, w = x - self._xhat, self.gains.bandwidth * OBSERVER
        self._xhat = self._xhat + dt * (known + self._disturbance + 2.0 * w * error)
        self._disturbance = self._disturbance + dt * w**2 * error
        wanted = self._reference.wanted(dt, x, reference) - self._disturbance
        return allocate(effect, wanted - unforced, self.limits, self.scale)


def without_flow(model: AttitudeModel, x: FloatArray) -> FloatArray:
    """Return the angular acceleration at zero inputs and flow angles, shape (3,).

    The observer estimates the effect of the flow angles.
    """
    state = np.append(x, (0.0, 0.0)) if model.structure.has_flow else x
    return model.acceleration(state, np.zeros(4))
