# SPDX-License-Identifier: Apache-2.0
"""What the inputs really do, measured in flight: a factor on the main derivative of each axis.

What the aircraft answers is compared with what its own input should have made (`Response`):

    answered = g made + rest

g = 1 is an effect as believed, 0 a lost one, -1 a reversed one. In a closed loop the inputs answer
the rest, gusts and gyro noise, so that least squares is pulled away. The instrument is what the
reference asks for, which no gust moves: g = sum(asked answered) / sum(asked made). Its standard
deviation takes the rest as it comes, with the correlation of neighbouring samples: as it was while
something was asked, at any time, or before, whichever is most. A single turn explains itself too
well.

What was measured before a change must not count after it. So the sums run over the last two
seconds, which tell that there was one, and from there on, which tell how much it is.

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

WINDOW = 2.0
"""Time over which a change is looked for, s. With 1.5 s gusts are taken for one half as often
again; with 2.5 s the median flight waits a quarter of a second longer."""

PERIOD = 0.05
"""Time between two looks, s: short beside it."""

CORRELATION = 0.3
"""Time over which what is not explained counts as the same, s: as long as the filter remembers a
gust, four and a half of its time constants."""

REST_MEMORY = 40.0
"""Time over which the mean of what is not explained is taken, s: long beside the window, in which a
change must not hide itself."""

NOISE_MEMORY = 3.0
"""Time over which the noise of the jerk is averaged, s: longer than a divergence lasts."""

OUTLIER = 3.0
"""Standard deviations of the noise beyond which a sample does not count as noise: the jerk of an
aileron that jams would hide for seconds that nothing answers it."""

LEAST_TIME = 0.7
"""Time from which on the noise of the jerk is known, s: five samples that count."""

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

LOOKS = round(WINDOW / PERIOD)
SHAPES = (2, 2, 3), (2, 2, 3, 3), (1, 3), (1, 3)
"""Looks of a window; of each sample, by axis last: answered and made, by what was asked and by what
was made; their products with those of the last samples, by these and 1; asked^2; 1."""

PLACES = np.cumsum([int(np.prod(shape[:-1])) for shape in SHAPES])
"""Rows up to the end of each, in the integrals."""


class Effectiveness:
    """Measured factor on the main derivative of each axis."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        # z answered and z made of each axis over the last samples, z what was asked for, 1, or made
        self._near = np.zeros((2, 3, 3))
        # What is not explained, over the last samples, and its mean power, (rad/s^3)^2 s
        self._near_rest, self._rest = np.zeros(3), np.zeros(3)
        # Integrals (`SHAPES`), with the mean rest in the last row: now, at the looks of the window
        # (the oldest of them is the next to be replaced), and when the last change began
        self._total = np.zeros((PLACES[-1] + 1, 3))
        self._looks, self._oldest = np.zeros((LOOKS, *self._total.shape)), 0
        self._start = np.zeros_like(self._total)
        self._noise, self._doubt = np.zeros((2, 3)), np.zeros((2, 3))  # reversed, lost
        self._age = self._since_look = 0.0
        # g of roll, pitch, yaw over the window, and its standard deviation, (3,)
        self.factor, self.sigma = np.ones(3), np.full(3, UNKNOWN)
        # The same over all the time since the last change began
        self.since, self.since_sigma = np.ones(3), np.full(3, UNKNOWN)
        # The same over the window by least squares, whatever moved the inputs
        self.moved, self.moved_sigma = np.ones(3), np.full(3, UNKNOWN)
        # Axes whose inputs surely did nothing when they last moved, (3,)
        self.dead: BoolArray = np.zeros(3, dtype=bool)

    @property
    def reversed(self) -> BoolArray:
        """Axes whose inputs surely act the other way than believed, shape (3,)."""
        return np.asarray(self._doubt[0] >= SURE)

    def changed(self, axis: int) -> None:
        """Go on after an axis's inputs do something else: nothing of it is known any more."""
        integrals = (part[..., : PLACES[-1], :] for part in (self._total, self._looks, self._start))
        for part in (self._near, self._near_rest, self._doubt, *integrals):
            part[..., axis] = 0.0
        self.factor[axis] = self.moved[axis] = self.since[axis] = 1.0
        self.sigma[axis] = self.moved_sigma[axis] = self.since_sigma[axis] = UNKNOWN
        self.dead[axis] = False

    def begin(self, axes: BoolArray) -> None:
        """Note that the effects of some axes, (3,), changed when the window began, or before."""
        self._start[:, axes] = self._looks[self._oldest][:, axes]
        self.since[axes], self.since_sigma[axes] = self.factor[axes], self.sigma[axes]

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
        keep = math.exp(-dt / CORRELATION)
        self._near = keep * self._near + sample
        products = dt**2 * sample[:, None] * (2.0 * self._near - sample)
        parts = dt * sample[:, ::2], products, dt * demanded**2, np.full(3, dt)
        self._total[:-1] += np.vstack([part.reshape(-1, 3) for part in parts])
        self._age += dt
        surely = np.abs(self.factor - believed) > OUTLIER * self.sigma
        rest = answered - np.where(surely, self.factor, believed) * made
        self._near_rest = keep * self._near_rest + rest
        power = dt * rest * (2.0 * self._near_rest - rest)
        self._rest += dt / min(self._age, REST_MEMORY) * (power - self._rest)
        if rival is not None:
            rival = rival[0], rival[1] * believed
        self._compare(answered, made * believed, dt, rival)
        self._since_look += dt
        if self._since_look >= PERIOD:
            self._since_look = 0.0
            self._look()
        if rival is not None:
            for sigma in (self.sigma, self.moved_sigma, self.since_sigma):
                sigma[:] = UNKNOWN

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

    def _look(self) -> None:
        """Find g and its sigma over the window and since the last change."""
        self._total[-1] = self._rest
        before = self._looks[self._oldest]
        (self.factor, self.moved), (self.sigma, self.moved_sigma) = self._solved(before)
        (self.since, _), (self.since_sigma, _) = self._solved(self._start)
        self._looks[self._oldest] = self._total
        self._oldest = (self._oldest + 1) % LOOKS

    def _solved(self, before: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return g by the instrument and by least squares, and sigma, since these integrals."""
        parts = np.split(self._total[:-1] - before[:-1], PLACES[:-1])
        sums, products, (demanded,), (time,) = (
            part.reshape(shape) for part, shape in zip(parts, SHAPES, strict=True)
        )
        (answered, made), (aa, am), (ma, mm) = sums, *products
        known = (time > WINDOW - PERIOD / 2.0) & (made != 0.0)
        made = np.where(known, made, 1.0)
        g = answered / made

        def variance(z: int, g: FloatArray) -> FloatArray:
            return np.asarray(aa[z] - g * (am[z] + ma[z]) + g**2 * mm[z])

        rest = np.maximum(variance(1, g[0]) / np.maximum(time, WINDOW), before[-1])
        spread = np.stack([np.maximum(variance(0, g[0]), rest * demanded), variance(2, g[1])])
        sigma = np.sqrt(np.maximum(spread, 0.0)) / np.abs(made)
        sigma = np.where(known, np.clip(sigma, LEAST_SIGMA, UNKNOWN), UNKNOWN)
        return np.where(known, g, 1.0), sigma
