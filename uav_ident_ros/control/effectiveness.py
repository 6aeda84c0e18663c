# SPDX-License-Identifier: Apache-2.0
"""What the inputs really do, measured in flight: a factor on the control derivatives, by axis.

The change of the angular acceleration is compared with the change that the inputs should have
made, after the axis's own damping and stiffness (by alpha or beta, which turn with it) are taken
out:

    jerk_f = g (B u)'_f + d xdot_f + s x_f

all through the same filter, over a second or two. g = 1 is an effect as believed, 0 a lost one,
-1 a reversed one. Two estimates of g, by what correlates the two sides:

- least squares without s, by whatever moves the inputs. It answers within half a second. In a
  closed loop gusts pull it towards 0, since the inputs answer them: for warnings and dead surfaces.
- instruments from the rate reference, which no gust moves: unbiased in a closed loop, and silent
  while the reference rests. Within what least squares allows, whatever the gusts, it serves to
  rescale what is flown on (`AxisChoice`).

A reversed effect leaves no second or two: an aileron turns an aircraft over in one and a half. For
it the hypotheses g = 1 and g = -1 are compared sample by sample, by the cumulative sum of their
log-likelihood ratio (Page's test), which keeps nothing of the time when all was well.

Instrumental variables in a closed loop: T. Söderström, P. Stoica, "System Identification",
Prentice Hall, 1989, chapters 8 and 10.
"""

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

SINGULAR = 1e-6
"""Determinant over the product of its rows' norms up to which a matrix is not inverted."""

LEAST_SIGMA = 0.1
"""Standard deviation of g that is believed at best: B is no constant."""

STRONG = 0.7
"""Share of the inputs' movement that must answer the reference: with the ten or so independent
samples of the memory, the F of 10 below which instruments are weak (Staiger and Stock, 1997)."""

SURE = 22.0
"""Log-likelihood ratio from which on an effect is reversed. On the c172p, severe gusts that begin
at once (6 of 7) reach 8, an aileron that loses half of its effect 7; a reversed one passes it in a
tenth of a second."""

LEAST_DOUBT = 0.1
"""Time that it takes at least, s. A load that shifts turns the aircraft one way while the inputs
already go the other, for as long as the filter remembers."""

DEAD, ALIVE = 0.3, 0.5
"""Factor below which an effect is lost, and above which a lost one is back, both by two sigma."""

PERIOD = 0.05
"""Time between answers, s: short beside the memory, as it costs more than the sums."""

UNKNOWN = 1e3
"""Standard deviation of g where nothing was measured."""


class Effectiveness:
    """Measured factor on the control derivatives of each axis.

    Attributes
    ----------
    factor, sigma : (3,) arrays
        g of roll, pitch, yaw by least squares, and its standard deviation.
    least, most : (3,) arrays
        g by the response to the reference, less and plus a standard deviation, within what least
        squares allows.
    dead : (3,) bool array
        Axes whose inputs surely did nothing when they last moved.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        self._smoothers: tuple[Smoother, Smoother] | None = None
        self._slope = np.zeros(6)
        self._noise = np.zeros(3)
        self._age = self._answered = 0.0
        self._weight = np.zeros(3)
        # sums over z f', z z' and z jerk, for the regressors f = (made, xdot, x) of each axis; z is
        # f itself in the first plane (least squares), of the reference in the second
        self._cross = np.zeros((2, 3, 3, 3))
        self._own = np.zeros((2, 3, 3, 3))
        self._products = np.zeros((2, 3, 3))
        self._squares = np.zeros(3)
        self.factor, self.sigma = np.ones(3), np.full(3, UNKNOWN)
        self.least, self.most = np.full(3, -UNKNOWN), np.full(3, UNKNOWN)
        self.dead: BoolArray = np.zeros(3, dtype=bool)
        self._doubt = np.zeros(3)

    @property
    def reversed(self) -> BoolArray:
        """Axes whose inputs surely act the other way, shape (3,)."""
        return self._doubt > SURE

    def changed(self, axis: int) -> None:
        """Go on after an axis's derivatives were changed: nothing of it is known any more."""
        for sums in (self._cross, self._own, self._products):
            sums[:, axis] = 0.0
        self._squares[axis] = self._weight[axis] = self._doubt[axis] = 0.0
        self.factor[axis], self.sigma[axis] = 1.0, UNKNOWN
        self.least[axis], self.most[axis] = -UNKNOWN, UNKNOWN
        self.dead[axis] = False

    def update(
        self,
        x: FloatArray,
        effect: FloatArray,
        acting: FloatArray,
        dt: float,
        reference: FloatArray | None = None,
        doubtful: bool = False,
    ) -> None:
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
        reference : (3,) array, optional
            The reference of those inputs, rad/s: one delay ago.
        doubtful : bool
            Whether these may not be the inputs that act now: then nothing is to be flown on.
        """
        followed = np.append(x, np.zeros(3) if reference is None else reference)
        if self._smoothers is None:
            self._smoothers = Smoother(BANDWIDTH, followed), Smoother(BANDWIDTH, acting)
            return
        rates, inputs = self._smoothers
        rates.update(followed, dt)
        inputs.update(acting, dt)
        made = effect @ inputs.slope
        jerks = (rates.slope - self._slope) / dt
        self._slope = rates.slope
        slope, jerk = rates.slope[:3], jerks[:3]
        regressors = np.column_stack([made, slope, rates.value[:3]])  # (3, 3)
        led = np.column_stack([jerks[3:], rates.slope[3:], rates.value[3:]])
        instruments = np.stack([regressors, led])
        keep = np.exp(-dt / MEMORY)
        columns, rows = instruments[..., :, None], instruments[..., None, :]
        self._cross = keep * self._cross + dt * columns * regressors[:, None, :]
        self._own = keep * self._own + dt * columns * rows
        self._products = keep * self._products + dt * instruments * jerk[:, None]
        self._squares = keep * self._squares + dt * jerk**2
        self._weight = keep * self._weight + dt
        self._age += dt
        self._compare(made, slope, jerk, dt)
        if self._age > self._answered + PERIOD:
            self._answered = self._age
            self._solve()
        if doubtful:
            self._doubt[:] = 0.0
            self.least[:], self.most[:] = -UNKNOWN, UNKNOWN

    def _compare(
        self, made: FloatArray, acceleration: FloatArray, jerk: FloatArray, dt: float
    ) -> None:
        """Weigh 'reversed' against 'as believed' by one sample; damping as if all were well."""
        squares = self._cross[0, :, 1, 1]
        cross = self._products[0, :, 1] - self._cross[0, :, 0, 1]
        damping = np.where(squares > 0.0, cross / np.where(squares > 0.0, squares, 1.0), 0.0)
        rest = jerk - np.minimum(damping, 0.0) * acceleration
        believed, turned = (rest - made) ** 2, (rest + made) ** 2
        share = min(1.0, dt / NOISE_MEMORY)
        self._noise = self._noise + share * (np.minimum(believed, turned) - self._noise)
        # what is larger than either says, as the jerk of a surface that breaks, tells neither
        heard = np.clip(rest, -2.0 * np.abs(made), 2.0 * np.abs(made))
        ratio = -2.0 * heard * made / np.maximum(self._noise, 1e-12)
        if self._age > LEAST_TIME:
            most = SURE * 2.0 / BANDWIDTH / LEAST_DOUBT
            step = np.clip(ratio, -most, most) * dt * BANDWIDTH / 2.0
            self._doubt = np.maximum(0.0, self._doubt + step)

    def _solve(self) -> None:
        """Find g, its sigma, what is dead and what may be flown on."""
        known = self._weight > LEAST_TIME
        self.factor, self.sigma = self._estimate(0, 2, known)
        spread = 2.0 * self.sigma
        self.dead = np.where(self.dead, self.factor - spread < ALIVE, self.factor + spread < DEAD)
        answered = self._cross[1, :, :, 0]
        inverse = np.linalg.pinv(self._own[1], hermitian=True)
        explained = (answered * (inverse @ answered[..., None])[..., 0]).sum(axis=-1)
        strong = known & (explained > STRONG * self._cross[0, :, 0, 0])
        followed, uncertain = self._estimate(1, 3, strong)
        # gusts that the inputs answer exactly would pull least squares by noise over signal
        away = self.sigma * (1.0 + np.sqrt(self._weight * BANDWIDTH / 2.0))
        low, high = self.factor - away, self.factor + away
        uncertain = np.maximum(uncertain, LEAST_SIGMA)
        self.least = np.clip(followed - uncertain, low, high)
        self.most = np.clip(followed + uncertain, low, high)

    def _estimate(self, plane: int, n: int, known: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return g and its sigma by the instruments of a plane, with n of the regressors."""
        m, own, f = (
            sums[:, :n, :n] for sums in (self._cross[plane], self._own[plane], self._cross[0])
        )
        products, squares = self._products[plane, :, :n], self._products[0, :, :n]
        size = np.linalg.norm(m, axis=-1).prod(axis=-1)
        known = known & (np.abs(np.linalg.det(m)) > SINGULAR * size)
        safe = np.where(known[:, None, None], m, np.eye(n))
        solved = _solution(safe, products)
        rest = self._squares - 2.0 * (solved * squares).sum(axis=-1)
        rest = rest + (solved * (f @ solved[..., None])[..., 0]).sum(axis=-1)
        told = self._weight * BANDWIDTH / 2.0  # samples that count; n are used up
        # neighbouring samples tell the same: one in 2 / bandwidth counts
        variance = np.maximum(rest, 0.0) / np.maximum(self._weight, 1e-9)
        variance = variance * told / np.maximum(told - n, 1e-9) * 2.0 / BANDWIDTH
        weights = _solution(safe.swapaxes(-1, -2), np.broadcast_to(np.eye(n)[0], products.shape))
        spread = (weights * (own @ weights[..., None])[..., 0]).sum(axis=-1)
        sigma = np.minimum(np.sqrt(variance * np.maximum(spread, 0.0)), UNKNOWN)
        return np.where(known, solved[:, 0], 1.0), np.where(known, sigma, UNKNOWN)


def _solution(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return M^-1 v of each axis, shape (3, n)."""
    return np.asarray(np.linalg.solve(matrices, vectors[..., None])[..., 0])
