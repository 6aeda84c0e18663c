# SPDX-License-Identifier: Apache-2.0
"""What an aircraft answers to its inputs: its jerk, less what it does by itself.

    jerk_f - (A_x xdot + A_f flow' + C u')_f = g (B u)'_f + what nobody knows

A is the linear model of the coefficients, B has what each axis's own input does, C what the others
do: an aileron's adverse yaw is no effect of the rudder. The rates are measured; beta and alpha that
go with them follow by the same model and the bank, so that no sensor of theirs is needed. In a
turn, which needs more lift, the weight counts as it is: a slow aircraft turns tightly. The same of
the rates that were asked for tells which inputs would have flown them: no gust and no gyro noise is
in that.

All of it passes one filter, and both meters (`Effectiveness`, `DelayMeter`) read it.
"""

import math

import numpy as np

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.control.allocation import MAINS
from uav_ident_ros.control.reference import Smoother
from uav_ident_ros.identification.flow import ATTITUDE_GAIN, FlowState
from uav_ident_ros.identification.linearisation import STATES, level_flight, linearise
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import ROWS, FloatArray

BANDWIDTH = 15.0
"""Of the filter, rad/s."""

FORGETTING = 30.0
"""Time constant with which flow angles return to zero, s: a gyro's bias adds up in them. Long
beside the memory of both meters. The bank returns to the observed one, as fast as that to gravity:
`ATTITUDE_GAIN`."""

AXES = slice(0, len(ROWS))
"""Of the states: the rates."""

BETA, ALPHA, PHI = range(len(ROWS), len(STATES))
"""Of the states: the others."""


class Response:
    """Filtered answer of the aircraft, and what its inputs should have made of it."""

    # (n, 3) Jerk of roll, pitch, yaw without the aircraft's own and what other inputs than the
    # axis's make, rad/s^3: a row for each delay
    answered: FloatArray
    made: FloatArray  # (n, 3) What the axis's own input should have made of it
    demanded: FloatArray  # (3,) The same of the inputs that would have flown the reference
    acceleration: FloatArray  # (3,) Measured, rad/s^2

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget the past."""
        self._smoothers: tuple[Smoother, Smoother] | None = None
        self._states = np.zeros((2, len(STATES)))
        self._model: AttitudeModel | None = None

    def update(
        self,
        x: FloatArray,  # (3,) Measured p, q, r, rad/s
        effect: FloatArray,  # (3, 4) B, rad/s^2 per unit
        inputs: FloatArray,  # (n, 4) The inputs that act now, for each delay
        dt: float,  # Time since the last sample, s
        model: AttitudeModel,  # What the aircraft does by itself
        # (3,) Rates that these inputs were to fly, rad/s: one delay ago
        reference: FloatArray | None = None,
    ) -> bool:
        """Take one sample; return whether there is an answer: not to the first one."""
        if model is not self._model:
            self._model, self._a = model, own_motion(model)
        self._states[:, AXES] = x, np.zeros(3) if reference is None else reference
        own = effect[:, MAINS].diagonal()
        if self._smoothers is None:
            self._smoothers = Smoother(BANDWIDTH, self._states), Smoother(BANDWIDTH, inputs)
            return False
        states, moved = self._smoothers
        before = states.slope
        states.update(self._states, dt)
        moved.update(inputs, dt)
        self._states = self._states + dt * self._slopes(model)  # the rates are replaced
        jerk = (states.slope - before)[:, AXES] / dt
        alone, demanded = jerk - (states.slope @ self._a.T)[:, AXES]
        self.made = moved.slope[:, MAINS] * own
        self.answered = alone - (moved.slope @ effect.T - self.made)
        self.demanded = own * (np.linalg.pinv(effect[:, MAINS]) @ demanded)
        self.acceleration = states.slope[0, AXES]
        return True

    def _slopes(self, model: AttitudeModel) -> FloatArray:
        """Time derivatives of the states, (2, 6): the linear ones, and the weight in a bank."""
        slopes = self._states @ self._a.T
        if (flow := _known_flow(model)) is not None:
            bank, weight = self._states[:, PHI], GRAVITY / flow.airspeed
            slopes[:, BETA] += weight * (np.sin(bank) - bank)
            slopes[:, ALPHA] += weight * (np.cos(bank) - 1.0)
            slopes[:, PHI] += ATTITUDE_GAIN * flow.roll
        return slopes


def _known_flow(model: AttitudeModel) -> FlowState | None:
    """Return the state of the flow; None where nobody knows an airspeed."""
    return model.flow if model.flow is not None and model.flow.airspeed > 0.0 else None


def own_motion(model: AttitudeModel) -> FloatArray:
    """Return A of ``d/dt (p, q, r, beta, alpha, phi)`` about level flight, shape (6, 6).

    Where nobody knows the airspeed it is that of the rates alone: in a turn sideslip would add up.
    """
    out = np.zeros((len(STATES), len(STATES)))
    flow = _known_flow(model)
    airspeed = math.inf if flow is None else flow.airspeed
    level = level_flight(model.structure, model.values, airspeed)
    a, _ = linearise(model.structure, model.values, level)
    known = AXES if flow is None else slice(0, len(a))
    out[known, known] = a[known, known]
    angles = np.array([BETA, ALPHA])
    out[angles, angles] -= 1.0 / FORGETTING
    out[PHI, PHI] -= ATTITUDE_GAIN
    return out
