# SPDX-License-Identifier: Apache-2.0
"""What the inputs really do, measured in flight: a factor on the main derivative of each axis.

What the aircraft answers is compared with what its own input should have made (`Response`):

    answered = g made + rest

g = 1 is an effect as believed, 0 a lost one, -1 a reversed one. In a closed loop the inputs answer
the rest, gusts and gyro noise, so that least squares is pulled away. The instrument is what the
reference asks for, which no gust moves: g = sum(asked answered) / sum(asked made). Its standard
deviation takes the rest as it comes, with the correlation of neighbouring samples: as it was while
something was asked, or at any time, whichever is more. A single turn explains itself too well.

Least squares has a use of its own: a loop that rings, as on an effect believed too small, moves its
inputs so much that the rest does not matter, while the reference asks for nothing.

A reversed or a lost effect leaves no second or two: an aileron turns an aircraft over in one and a
half. For these the hypotheses g = 1 and -1, and g = 1/2 and 0, are compared sample by sample, by
the cumulative sum of their log-likelihood ratio (Page's test), which keeps nothing of the time
when all was well.

Instrumental variables in a closed loop: T. Söderström, P. Stoica, "System Identification",
Prentice Hall, 1989, chapters 8 and 10; the standard deviation: W. K. Newey, K. D. West, "A simple,
positive semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix",
Econometrica 55(3), 1987.
"""

import math

import numpy as np

from uav_ident_ros.control.response import BANDWIDTH
from uav_ident_ros.identification.structure import BoolArray, FloatArray

MEMORY = 1.5
"""Time in which the weight of what was measured falls to 1 / e, s."""

CORRELATION = 0.3
"""Time over which what is not explained counts as the same, s: as long as the filter remembers a
gust, four and a half of its time constants."""

NOISE_MEMORY = 3.0
"""Time over which the noise of the jerk is averaged, s: longer than a divergence lasts."""

OUTLIER = 3.0
"""Standard deviations of the noise beyond which a sample does not count as noise: the jerk of an
aileron that jams would hide for seconds that nothing answers it."""

LEAST_TIME = 0.7
"""Weight from which on there is an answer, s: five samples that count."""

LEAST_SIGMA = 0.1
"""Standard deviation of g that is believed at best: B is no constant."""

SURE = 22.0
"""Log-likelihood ratio from which on an effect is reversed or lost. On the c172p, severe gusts that
begin at once (6 of 7) reach 8 for 'reversed', an aileron that loses half of its effect 7; a
reversed one passes it in a tenth of a second."""

LEAST_DOUBT = 0.1
"""Time that it takes at least, s. A load that shifts turns the aircraft one way while the inputs
already go the other, for as long as the filter remembers."""

HYPOTHESES = np.array([[1.0], [0.5]]), np.array([[-1.0], [0.0]])
"""Factors as believed, and of a reversed and a lost effect. Half of it is a weak effect, no lost
one."""

UNKNOWN = 1e3
"""Standard deviation of g where nothing was measured."""


class Effectiveness:
    """Measured factor on the main derivative of each axis."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        # z answered and z made of each axis, z what was asked for, 1, or made: over the last
        # samples, and as sums over the memory; products of each sample with the last ones; asked^2
        self._near, self._sums = np.zeros((2, 3, 3)), np.zeros((2, 3, 3))
        self._products = np.zeros((2, 2, 3, 3))
        self._demanded = np.zeros(3)
        self._weight = np.zeros(3)
        self._noise, self._doubt = np.zeros((2, 3)), np.zeros((2, 3))  # reversed, lost
        self._age = 0.0
        # g of roll, pitch, yaw, and its standard deviation, (3,)
        self.factor, self.sigma = np.ones(3), np.full(3, UNKNOWN)
        # The same by least squares, whatever moved the inputs
        self.moved, self.moved_sigma = np.ones(3), np.full(3, UNKNOWN)
        # Axes whose inputs surely did nothing when they last moved, (3,)
        self.dead: BoolArray = np.zeros(3, dtype=bool)

    @property
    def reversed(self) -> BoolArray:
        """Axes whose inputs surely act the other way than believed, shape (3,)."""
        return np.asarray(self._doubt[0] >= SURE)

    def changed(self, axis: int) -> None:
        """Go on after an axis's inputs do something else: nothing of it is known any more."""
        sums = self._near, self._sums, self._products, self._demanded, self._weight, self._doubt
        for one in sums:
            one[..., axis] = 0.0
        self.factor[axis] = self.moved[axis] = 1.0
        self.sigma[axis] = self.moved_sigma[axis] = UNKNOWN
        self.dead[axis] = False

    def update(
        self,
        answered: FloatArray,  # answered, made: (3,) As in `Response`, rad/s^3
        made: FloatArray,
        dt: float,  # Time since the last sample, s
        # (3,) As in `Response`. Where nobody asked, what was made stands for it: least squares
        demanded: FloatArray | None = None,
        # (3,) Factors that are flown on: which way the inputs should act
        believed: FloatArray | float = 1.0,
        # What was answered to the inputs, and made by them, if others may act now: by another delay
        rival: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """Take one sample."""
        demanded = made if demanded is None else demanded
        instruments = np.stack([demanded, np.ones_like(demanded), made])
        sample = np.stack([answered, made])[:, None] * instruments
        self._near = math.exp(-dt / CORRELATION) * self._near + sample
        products = sample[:, None] * (2.0 * self._near - sample)
        keep = math.exp(-dt / MEMORY)
        self._sums = keep * self._sums + dt * sample
        self._products = keep * self._products + dt**2 * products
        self._demanded = keep * self._demanded + dt * demanded**2
        self._weight = keep * self._weight + dt
        self._age += dt
        if rival is not None:
            rival = rival[0], rival[1] * believed
        self._compare(answered, made * believed, dt, rival)
        self._solve()
        if rival is not None:
            self.sigma[:] = self.moved_sigma[:] = UNKNOWN

    def _compare(
        self,
        answered: FloatArray,
        made: FloatArray,
        dt: float,
        rival: tuple[FloatArray, FloatArray] | None,
    ) -> None:
        """Weigh 'reversed' against 'as believed', and 'lost' against half of it, by one sample."""
        believed, instead = HYPOTHESES
        rest = np.minimum((answered - made) ** 2, (answered - instead * made) ** 2)
        if self._age >= LEAST_TIME:
            rest = np.minimum(rest, OUTLIER**2 * self._noise)
        self._noise = self._noise + min(1.0, dt / NOISE_MEMORY) * (rest - self._noise)
        if self._age < LEAST_TIME:
            return
        # what is larger than any says, as the jerk of a surface that breaks, tells nothing
        clipped = np.clip(answered, -2.0 * np.abs(made), 2.0 * np.abs(made))
        plain = (clipped - believed * made) ** 2
        if rival is not None:  # nothing is wrong with the inputs that another delay explains
            plain = np.minimum(plain, (rival[0] - rival[1]) ** 2)
        ratio = plain - (clipped - instead * made) ** 2
        step = BANDWIDTH / 2.0 * ratio / (2.0 * np.maximum(self._noise, 1e-12))
        most = SURE / LEAST_DOUBT
        self._doubt = np.clip(self._doubt + dt * np.clip(step, -most, most), 0.0, SURE)
        lost = self._doubt[1]
        self.dead = np.where(self.dead, lost > 0.0, lost >= SURE)

    def _solve(self) -> None:
        """Find g and its sigma, by the instrument and by least squares."""
        (answered, made), (aa, am), (ma, mm) = self._sums[:, ::2], *self._products
        known = (self._weight > LEAST_TIME) & (made != 0.0)
        made = np.where(known, made, 1.0)
        g = answered / made

        def variance(z: int, g: FloatArray) -> FloatArray:
            return np.asarray(aa[z] - g * (am[z] + ma[z]) + g**2 * mm[z])

        ever = variance(1, g[0]) * self._demanded / np.maximum(self._weight, LEAST_TIME)
        spread = np.stack([np.maximum(variance(0, g[0]), ever), variance(2, g[1])])
        sigma = np.sqrt(np.maximum(spread, 0.0)) / np.abs(made)
        sigma = np.where(known, np.clip(sigma, LEAST_SIGMA, UNKNOWN), UNKNOWN)
        self.factor, self.moved = np.where(known, g, 1.0)
        self.sigma, self.moved_sigma = sigma
