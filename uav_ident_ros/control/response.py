# SPDX-License-Identifier: Apache-2.0
"""Response of the aircraft to its inputs: the jerk without that of the aircraft's own dynamics.

    jerk_f - (A_x xdot + A_f flow' + C u')_f = g (B u)'_f + rest

A is the linear model of the coefficients, B the main control derivatives, C the cross ones: an
aileron's adverse yaw is no effect of the rudder. The rates are measured. beta and alpha follow from
them by the same model and the bank angle, so that no flow sensor is needed. The weight enters with
the sine and cosine of the bank, since a slow aircraft turns tightly. The same model, run on the
rate reference, gives the inputs that the reference demands, free of gusts and gyro noise.

All signals pass one filter. `Effectiveness` and `DelayMeter` use them.
"""

import math

import numpy as np

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.control.allocation import MAIN_EFFECTS
from uav_ident_ros.control.laws import Smoother
from uav_ident_ros.identification.flow import ATTITUDE_GAIN, FlowState
from uav_ident_ros.identification.linearisation import STATES, level_flight, linearise
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import MAIN_PLACES, ROWS, FloatArray

BANDWIDTH = 15.0
"""Bandwidth of the filter, rad/s."""

FORGETTING = 30.0
"""Time constant with which flow angles return to zero, s, since a gyro's bias accumulates in them.
It is long relative to the memories of both estimators. The bank angle returns to the observed one
with `ATTITUDE_GAIN`."""

STATE_RATES = slice(0, len(ROWS))
"""Indices of the rates in the state."""

BETA, ALPHA, PHI = range(len(ROWS), len(STATES))
"""Indices of the angles in the state."""


class Response:
    """Filtered response of the aircraft, and the response expected of its inputs."""

    # (n, 3) Jerk of roll, pitch, yaw without the aircraft's own dynamics and the cross effects of
    # inputs, rad/s^3: a row for each delay
    answered: FloatArray
    made: FloatArray  # (n, 3) Expected jerk by the axis's own input, rad/s^3
    demanded: FloatArray  # (3,) Expected jerk by the inputs that the reference demands, rad/s^3
    acceleration: FloatArray  # (3,) Measured angular acceleration, rad/s^2

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset filters and states."""
        self._smoothers: tuple[Smoother, Smoother] | None = None
        self._states = np.zeros((2, len(STATES)))
        self._model: AttitudeModel | None = None

    def update(
        self,
        x: FloatArray,  # (3,) Measured p, q, r, rad/s
        effect: FloatArray,  # (3, 4) B, rad/s^2 per unit
        inputs: FloatArray,  # (n, 4) The inputs that act now, for each delay
        dt: float,  # Time since the last sample, s
        model: AttitudeModel,  # Model of the aircraft's own dynamics
        # (3,) Rate reference one delay ago, rad/s
        reference: FloatArray | None = None,
    ) -> bool:
        """Add one sample; return whether there is a response: not after the first one."""
        if model is not self._model:
            self._model, self._a = model, own_motion(model)
        self._states[:, STATE_RATES] = x, np.zeros(3) if reference is None else reference
        own = effect[MAIN_EFFECTS]
        if self._smoothers is None:
            self._smoothers = Smoother(BANDWIDTH, self._states), Smoother(BANDWIDTH, inputs)
            return False
        states, moved = self._smoothers
        before = states.slope
        states.update(self._states, dt)
        moved.update(inputs, dt)
        self._states = self._states + dt * self._slopes(model)  # measured rates replace those
        jerk = (states.slope - before)[:, STATE_RATES] / dt
        alone, demanded = jerk - (states.slope @ self._a.T)[:, STATE_RATES]
        self.made = moved.slope[:, MAIN_PLACES] * own
        self.answered = alone - (moved.slope @ effect.T - self.made)
        self.demanded = own * (np.linalg.pinv(effect[:, MAIN_PLACES]) @ demanded)
        self.acceleration = states.slope[0, STATE_RATES]
        return True

    def _slopes(self, model: AttitudeModel) -> FloatArray:
        """Return the derivatives of the states, (2, 6): linear but for the weight in a bank."""
        slopes = self._states @ self._a.T
        if (flow := _known_flow(model)) is not None:
            bank, weight = self._states[:, PHI], GRAVITY / flow.airspeed
            slopes[:, BETA] += weight * (np.sin(bank) - bank)
            slopes[:, ALPHA] += weight * (np.cos(bank) - 1.0)
            slopes[:, PHI] += ATTITUDE_GAIN * flow.roll
        return slopes


def _known_flow(model: AttitudeModel) -> FlowState | None:
    """Return the state of the flow; None without a known airspeed."""
    return model.flow if model.flow is not None and model.flow.airspeed > 0.0 else None


def own_motion(model: AttitudeModel) -> FloatArray:
    """Return A of ``d/dt (p, q, r, beta, alpha, phi)`` about level flight, shape (6, 6).

    Without a known airspeed it has the rates alone: sideslip would drift in a turn.
    """
    out = np.zeros((len(STATES), len(STATES)))
    flow = _known_flow(model)
    airspeed = math.inf if flow is None else flow.airspeed
    level = level_flight(model.structure, model.values, airspeed)
    a, _ = linearise(model.structure, model.values, level)
    known = STATE_RATES if flow is None else slice(0, len(a))
    out[known, known] = a[known, known]
    angles = np.array([BETA, ALPHA])
    out[angles, angles] -= 1.0 / FORGETTING
    out[PHI, PHI] -= ATTITUDE_GAIN
    return out
