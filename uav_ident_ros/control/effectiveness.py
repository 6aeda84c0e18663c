# SPDX-License-Identifier: Apache-2.0
"""What the inputs really do, measured in flight: a factor on the control derivatives, by axis.

The change of the angular acceleration is compared with the change that the inputs should have
made, after the axis's own damping is taken out:

    jerk_f = g (B u)'_f + d xdot_f

all through the same filter, by recursive least squares over a second or two. g = 1 is an effect as
believed, 0 a lost one, -1 a reversed one. It is quick and crude: gusts pull it towards 0 in a
closed loop, since the inputs answer them. So it serves for warnings.

A reversed effect leaves no second or two: an aileron turns an aircraft over in one and a half. For
it the hypotheses g = 1 and g = -1 are compared sample by sample, by the cumulative sum of their
log-likelihood ratio (Page's test), which keeps nothing of the time when all was well.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.control.smoothing import Smoother
from uav_ident_ros.identification.structure import BoolArray, FloatArray

MEMORY = 1.5
"""Time in which the weight of what was measured falls to 1 / e, s."""

NOISE_MEMORY = 3.0
"""Time over which the noise of the jerk is averaged, s: longer than a divergence lasts."""

BANDWIDTH = 15.0
"""Of the filters, rad/s."""

LEAST_TIME = 0.7
"""Weight from which on there is an answer, s: five samples that count, for two unknowns."""

SURE = 22.0
"""Log-likelihood ratio from which on an effect is reversed. On the c172p, severe gusts that begin
at once (6 of 7) reach 8, an aileron that loses half of its effect 7; a reversed one passes it in a
tenth of a second."""

DEAD, ALIVE = 0.3, 0.5
"""Factor below which an effect is lost, and above which a lost one is back, both by two sigma."""

UNKNOWN = 1e3
"""Standard deviation of g where nothing was measured."""


class Effectiveness:
    """Measured factor on the control derivatives of each axis.

    Attributes
    ----------
    factor, sigma : (3,) arrays
        g of roll, pitch, yaw, and its standard deviation.
    dead : (3,) bool array
        Axes whose inputs surely did nothing when they last moved.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        self._smoothers: tuple[Smoother, Smoother] | None = None
        self._information = np.zeros((3, 2, 2))
        self._products = np.zeros((3, 2))
        self._squares = np.zeros(3)
        self._weight = 0.0
        self._slope = np.zeros(3)
        self.factor = np.ones(3)
        self.sigma = np.full(3, UNKNOWN)
        self.dead: BoolArray = np.zeros(3, dtype=bool)
        self._doubt = np.zeros(3)
        self._noise = np.zeros(3)

    @property
    def reversed(self) -> BoolArray:
        """Axes whose inputs surely act the other way, shape (3,)."""
        return self._doubt > SURE

    def turned(self, axis: int) -> None:
        """Go on after the sign of an axis was changed: nothing of it is known any more."""
        self._doubt[axis] = 0.0
        self._information[axis], self._products[axis], self._squares[axis] = 0.0, 0.0, 0.0

    def update(self, x: FloatArray, effect: FloatArray, acting: FloatArray, dt: float) -> None:
        """Take one sample.

        Parameters
        ----------
        x : (3,) array
            Measured p, q, r, rad/s.
        effect : (3, 4) array
            B as believed, rad/s^2 per unit.
        acting : (4,) array
            The inputs that act now.
        dt : float
            Time since the last sample, s.
        """
        if self._smoothers is None:
            self._smoothers = Smoother(BANDWIDTH, x), Smoother(BANDWIDTH, acting)
            return
        rates, inputs = self._smoothers
        rates.update(x, dt)
        inputs.update(acting, dt)
        made = effect @ inputs.slope
        jerk = (rates.slope - self._slope) / dt
        self._slope = rates.slope
        regressors = np.column_stack([made, rates.slope])  # (3, 2)
        keep = np.exp(-dt / MEMORY)
        self._information = keep * self._information + dt * (
            regressors[:, :, None] * regressors[:, None, :]
        )
        self._products = keep * self._products + dt * regressors * jerk[:, None]
        self._squares = keep * self._squares + dt * jerk**2
        self._weight = keep * self._weight + dt
        self._compare(made, rates.slope, jerk, dt)
        self._solve()

    def _compare(
        self, made: FloatArray, acceleration: FloatArray, jerk: FloatArray, dt: float
    ) -> None:
        """Weigh 'reversed' against 'as believed' by one sample; damping as if all were well."""
        squares = self._information[:, 1, 1]
        cross = self._products[:, 1] - self._information[:, 0, 1]
        damping = np.where(squares > 0.0, cross / np.where(squares > 0.0, squares, 1.0), 0.0)
        rest = jerk - np.minimum(damping, 0.0) * acceleration
        believed, turned = (rest - made) ** 2, (rest + made) ** 2
        share = min(1.0, dt / NOISE_MEMORY)
        self._noise = self._noise + share * (np.minimum(believed, turned) - self._noise)
        if self._weight > LEAST_TIME:
            # what is larger than either says, as the jerk of a surface that breaks, tells neither
            heard = np.clip(rest, -2.0 * np.abs(made), 2.0 * np.abs(made))
            ratio = -2.0 * heard * made / np.maximum(self._noise, 1e-12)
            self._doubt = np.maximum(0.0, self._doubt + ratio * dt * BANDWIDTH / 2.0)

    def _solve(self) -> None:
        a, b, c = (self._information[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        determinant = a * c - b**2
        good = (determinant > 1e-6 * a * c) & (self._weight > LEAST_TIME)
        safe = np.where(good, determinant, 1.0)
        g = (c * self._products[:, 0] - b * self._products[:, 1]) / safe
        d = (a * self._products[:, 1] - b * self._products[:, 0]) / safe
        told = self._weight * BANDWIDTH / 2.0  # samples that count; two are used up
        rest = self._squares - g * self._products[:, 0] - d * self._products[:, 1]
        # neighbouring samples tell the same: one in 2 / bandwidth counts
        variance = np.maximum(rest, 0.0) / self._weight * told / max(told - 2.0, 1e-9)
        sigma = np.sqrt(variance * c / safe * (2.0 / BANDWIDTH))
        self.factor = np.where(good, g, 1.0)
        self.sigma = np.where(good, np.minimum(sigma, UNKNOWN), UNKNOWN)
        least, most = self.factor - 2.0 * self.sigma, self.factor + 2.0 * self.sigma
        self.dead = np.where(self.dead, least < ALIVE, most < DEAD)
