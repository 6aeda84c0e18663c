# SPDX-License-Identifier: Apache-2.0
"""The control laws: incremental inversion (INDI), and inversion of the whole model."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.control.allocation import allocate
from uav_ident_ros.control.sideslip import LARGEST_YAW_RATE
from uav_ident_ros.identification.structure import FloatArray

MAX_INTERVAL = 0.1
"""Interval of the Imu above which a loop restarts, s."""


@dataclass(frozen=True)
class Gains:
    """Tuning of a control law."""

    rate: tuple[float, float, float]  # (3,) K: acceleration per rate error of roll, pitch, yaw, 1/s
    bandwidth: float  # Bandwidth of the law's filter or observer, rad/s
    reference_time: float = 0.1  # Time constant of the reference's derivative, s

    def times(self, factor: float) -> Gains:
        """Return the gains of a loop that is faster by a factor."""
        p, q, r = (factor * gain for gain in self.rate)
        return replace(self, rate=(p, q, r), bandwidth=factor * self.bandwidth)


DAMPING_RATIO = 0.8
"""Damping ratio of the common filter of rates and inputs: an overshoot of 1.5 %."""


class Smoother:
    """Low-pass ``w^2 / (s^2 + 2 d w s + w^2)`` of a vector, exact for held inputs."""

    def __init__(
        self,
        bandwidth: float,  # w, rad/s
        start: FloatArray,  # (n,) Value at rest
    ) -> None:
        self._bandwidth = bandwidth
        # Filtered signal and its derivative, 1/s
        self.value = np.array(start, dtype=np.float64)
        self.slope = np.zeros_like(self.value)

    def update(self, signal: FloatArray, dt: float) -> None:
        """Advance by `dt` s with `signal` held."""
        w = self._bandwidth
        decay, damped = DAMPING_RATIO * w, w * np.sqrt(1.0 - DAMPING_RATIO**2)
        away = self.value - signal
        c, s = np.cos(damped * dt), np.sin(damped * dt) / damped
        e = np.exp(-decay * dt)
        self.value = signal + e * (away * (c + decay * s) + self.slope * s)
        self.slope = e * (self.slope * (c - decay * s) - away * w**2 * s)


@dataclass
class TrackingLaw:
    """The wanted acceleration of all laws: ``reference' + K (reference - x)``.

    The reference is differentiated with a lag.
    """

    limits: FloatArray  # (2, 4) Lower and upper limits of de, dr, da, dth, deviations from trim
    scale: FloatArray  # (3,) Unit of the acceleration of each axis, rad/s^2: see `allocate`
    gains: Gains
    _smooth: FloatArray = field(init=False)  # (3,) The lagged reference

    def _wanted(self, dt: float, x: FloatArray, reference: FloatArray) -> FloatArray:
        """Return the acceleration `dt` s later, shape (3,)."""
        slope = (reference - self._smooth) / self.gains.reference_time
        self._smooth = self._smooth + dt * slope
        return np.asarray(slope + np.array(self.gains.rate) * (reference - x))


@dataclass
class IncrementalLaw(TrackingLaw):
    """Incremental nonlinear dynamic inversion (INDI): measured accelerations replace the model.

        u = u_f + B^-1 (reference' + K (reference - x) - xdot_f)

    xdot_f is the angular acceleration from the gyro, u_f the inputs that caused it. Both pass the
    same filter, and the inputs have the delay of the surfaces, so that they are synchronous. xdot_f
    contains the aircraft's own dynamics, trim and gusts. Of the model only the control derivatives
    B are needed. They may be wrong: the loop converges for any true effect between zero and twice
    B, at a rate proportional to their ratio.

    S. Sieberling, Q. P. Chu, J. A. Mulder, "Robust flight control using incremental nonlinear
    dynamic inversion and angular acceleration prediction", JGCD 33(6), 2010; E. J. J. Smeur,
    Q. Chu, G. C. H. E. de Croon, "Adaptive incremental nonlinear dynamic inversion for attitude
    control of micro air vehicles", JGCD 39(3), 2016.
    """

    # For a light aircraft at 100 Hz with a delay of 20 ms
    gains: Gains = Gains(rate=(5.0, 4.0, 2.0), bandwidth=20.0)

    def restart(self, x: FloatArray, reference: FloatArray, acting: FloatArray) -> None:
        """Reset the filters at the first sample, or after a gap. Parameters as of `update`."""
        self._rates = Smoother(self.gains.bandwidth, x)
        self._inputs = Smoother(self.gains.bandwidth, acting)
        self._smooth = np.array(reference, dtype=np.float64)

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
        missing = self._wanted(dt, x, reference) - self._rates.slope
        # limited to the rudder's authority: at its stops it lags and destabilises the Dutch roll
        most = min(LARGEST_YAW_RATE, self.scale[2] / self.gains.rate[2])
        missing[2] += self.gains.rate[2] * np.clip(yaw_for_roll * missing[0], -most, most)
        return allocate(effect, effect @ self._inputs.value + missing, self.limits, self.scale)


OBSERVER = np.array([1.0, 1.0, 0.5])
"""Bandwidth of the observer by axis, over that of the gains: yaw is the slower loop."""


@dataclass
class InversionLaw(TrackingLaw):
    """Inversion of the identified model with a disturbance observer.

        u = B^-1 (reference' + K (reference - x) - d - A f(x, 0))

    d is the disturbance: trim, gusts, the flow angles, errors of A and B. An observer estimates it
    from the rates and the delayed commands, without differentiating::

        xhat' = A f(x, u) + d + 2 w (x - xhat)        d' = w^2 (x - xhat)

    The loop thus has integral action: a wrong model makes it slow, not unstable.
    """

    # For a light aircraft at 100 Hz with a delay of 20 ms
    gains: Gains = Gains(rate=(5.0, 4.0, 2.0), bandwidth=8.0)

    def restart(
        self, model: AttitudeModel, effect: FloatArray, x: FloatArray, reference: FloatArray
    ) -> None:
        """Reset the observer at the first sample, or after a gap."""
        self._model, self._effect = model, effect
        self._xhat, self._disturbance = x, np.zeros(3)
        self._smooth = np.array(reference, dtype=np.float64)

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
        unforced = acceleration_without_flow(model, x)
        known = unforced + effect @ acting
        # bumpless transfer to a new model: the sum of model and disturbance stays
        before = acceleration_without_flow(self._model, x) + self._effect @ acting
        self._disturbance = self._disturbance + before - known
        self._model, self._effect = model, effect
        error, w = x - self._xhat, self.gains.bandwidth * OBSERVER
        self._xhat = self._xhat + dt * (known + self._disturbance + 2.0 * w * error)
        self._disturbance = self._disturbance + dt * w**2 * error
        wanted = self._wanted(dt, x, reference) - self._disturbance
        return allocate(effect, wanted - unforced, self.limits, self.scale)


def acceleration_without_flow(model: AttitudeModel, x: FloatArray) -> FloatArray:
    """Return the angular acceleration at zero inputs and flow angles, shape (3,).

    The observer estimates the effect of the flow angles.
    """
    state = np.append(x, (0.0, 0.0)) if model.structure.has_flow else x
    return model.acceleration(state, np.zeros(4))
