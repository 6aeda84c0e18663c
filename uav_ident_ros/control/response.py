# SPDX-License-Identifier: Apache-2.0
"""What an aircraft answers to its inputs: its jerk, less what it does by itself.

    jerk_f - (A_x xdot + A_f flow')_f = (g B u)'_f + what nobody knows

A is the linear model of the coefficients. Its rates are measured; beta, alpha and the
bank angle that go with them follow from them by the same model, so that no sensor of theirs is
needed. The same of the rates that were asked for tells which inputs would have flown them: no
gust and no gyro noise is in that.

All of it passes one filter, and both meters (`Effectiveness`, `DelayMeter`) read it.
"""

import math

import numpy as np

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.control.reference import Smoother
from uav_ident_ros.identification.linearisation import STATES, level_flight, linearise
from uav_ident_ros.identification.structure import ROWS, FloatArray

BANDWIDTH = 15.0
"""Of the filter, rad/s."""

FORGETTING = 30.0
"""Time constant with which flow and bank angles return to zero, s: a gyro's bias adds up in them.
Long beside the memory of both meters."""

AXES = slice(0, len(ROWS))
"""Of the states: the rates."""


class Response:
    """Filtered answer of the aircraft, and what its inputs should have made of it."""

    answered: FloatArray  # (3,) Jerk of roll, pitch, yaw without the aircraft's own, rad/s^3
    demanded: FloatArray  # (3,) The same if the rates had been those of the reference
    acceleration: FloatArray  # (3,) Measured, rad/s^2
    made: FloatArray  # (n, 3) What the inputs should have made of it: a row for each delay

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
        if self._smoothers is None:
            self._smoothers = Smoother(BANDWIDTH, self._states), Smoother(BANDWIDTH, inputs)
            return False
        states, moved = self._smoothers
        before = states.slope
        states.update(self._states, dt)
        moved.update(inputs, dt)
        self._states = self._states + dt * self._states @ self._a.T  # the rates are replaced
        jerk = (states.slope - before)[:, AXES] / dt
        self.answered, self.demanded = jerk - (states.slope @ self._a.T)[:, AXES]
        self.acceleration, self.made = states.slope[0, AXES], moved.slope @ effect.T
        return True


def own_motion(model: AttitudeModel) -> FloatArray:
    """Return A of ``d/dt (p, q, r, beta, alpha, phi)`` about level flight, shape (6, 6).

    Where nobody knows the airspeed it is that of the rates alone: in a turn sideslip would add up.
    """
    out = np.zeros((len(STATES), len(STATES)))
    airspeed = math.inf if model.flow is None else model.flow.airspeed
    level = level_flight(model.structure, model.values, airspeed)
    a, _ = linearise(model.structure, model.values, level)
    known = AXES if model.flow is None else slice(0, len(a))
    out[known, known] = a[known, known]
    flow = np.arange(len(ROWS), len(STATES))
    out[flow, flow] -= 1.0 / FORGETTING
    return out
