# SPDX-License-Identifier: Apache-2.0
"""Control effectiveness, measured in flight: a factor g on the main derivative of each axis.

The measured jerk is compared with the jerk that the axis's own input should produce (`Response`):

    answered = g made + rest

g = 1 is the assumed effect, 0 a lost one, -1 a reversed one. Feedback correlates the inputs with
the rest, gusts and gyro noise, which biases least squares. The instrument is the jerk that the
reference demands, which no gust moves: g = sum(demanded answered) / sum(demanded made). Its sigma
follows from the autocovariance of the rest. The largest of three estimates counts: weighted by the
demand, over the time of the sums, and before it. A single manoeuvre fits itself too well.

Measurements before a change must not count after it. One set of sums therefore runs over the last
two seconds and detects a change; another runs from the change on and measures its size.

Least squares serves where the loop oscillates, as with too small an assumed effect. The inputs
then move so much that the bias is small, while the reference demands nothing.

A reversed or lost effect needs a faster test: a lost aileron rolls an aircraft over in 1.5 s. The
hypotheses g = 1 and -1, and g = 1/2 and 0, are compared at each sample by the cumulative sum of
their log-likelihood ratio (Page's test). The sum is bounded below by zero, so that the time without
a fault does not delay the detection.

Instrumental variables in a closed loop: T. Söderström, P. Stoica, "System Identification",
Prentice Hall, 1989, chapters 8 and 10; the standard deviation: W. K. Newey, K. D. West, "A simple,
positive semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix",
Econometrica 55(3), 1987.
"""

import math

import numpy as np

from uav_ident_ros.control.response import BANDWIDTH
from uav_ident_ros.identification.structure import BoolArray, FloatArray

CHANGE_WINDOW = 2.0
"""Window in which a change is detected, s. With 1.5 s, false alarms by gusts are half as many
again; with 2.5 s the median flight waits 0.25 s longer."""

EVALUATION_PERIOD = 0.05
"""Time between two evaluations, s: short relative to the window."""

CORRELATION = 0.3
"""Correlation time of the rest, s: a gust decays in the filter within four and a half of its time
constants."""

REST_MEMORY = 40.0
"""Averaging time of the power of the rest, s: long relative to the window, so that a change does
not raise it at once."""

NOISE_MEMORY = 3.0
"""Time over which the noise of the jerk is averaged, s: longer than a divergence lasts."""

OUTLIER = 3.0
"""Standard deviations of the noise at which the residual of a sample is limited: otherwise the jerk
of a jamming aileron would mask the lost effect for seconds."""

LEAST_TIME = 0.7
"""Time after which the noise of the jerk is known, s: five independent samples."""

LEAST_SIGMA = 0.1
"""Lower bound of the standard deviation of g: B is not constant."""

CERTAIN = 22.0
"""Log-likelihood ratio from which an effect counts as reversed or lost. On the c172p, a sudden
onset of severe gusts (6 of 7) reaches 8 for 'reversed', an aileron with half of its effect 7; a
reversed one passes it in 0.2 s."""

LEAST_DETECTION_TIME = np.array([[0.15], [0.1]])
"""Shortest times to reach `CERTAIN`, reversed and lost, s. A shifting load, or a motor that loses
thrust, turns the aircraft one way while the inputs already move the other way, for as long as the
filter keeps it. With 0.1 s four of 54 quadrotors with such a motor fly with a reversed input."""

EFFECT_HYPOTHESES = np.array([[1.0], [0.5]]), np.array([[-1.0], [0.0]])
"""Factors of the null hypotheses, and of their alternatives 'reversed' and 'lost'. Half of the
effect is weak, not lost."""

UNKNOWN = 1e3
"""Standard deviation of g before any measurement."""

EVALUATIONS = round(CHANGE_WINDOW / EVALUATION_PERIOD)
SHAPES = (2, 2, 3), (2, 2, 3, 3), (1, 3), (1, 3)
"""Evaluations in a window, and shapes of the integrals, axes last: answered and made times demanded
and made; their autocovariances, times demanded, 1 and made; demanded^2; 1."""

PLACES = np.cumsum([int(np.prod(shape[:-1])) for shape in SHAPES])
"""End row of each of them in the array of integrals."""


class Effectiveness:
    """Measured factor on the main derivative of each axis."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Discard all measurements."""
        # Fading sums of z answered and z made, for z = demanded, 1 and made, of each axis
        self._recent = np.zeros((2, 3, 3))
        # Fading sum of the rest, and its mean power, (rad/s^3)^2 s
        self._recent_rest, self._rest = np.zeros(3), np.zeros(3)
        # Integrals (`SHAPES`), with the power of the rest in the last row: now, at the evaluations
        # of the window (a ring buffer), and at the start of the last change
        self._total = np.zeros((PLACES[-1] + 1, 3))
        self._past, self._oldest = np.zeros((EVALUATIONS, *self._total.shape)), 0
        self._start = np.zeros_like(self._total)
        self._noise, self._log_ratio = np.zeros((2, 3)), np.zeros((2, 3))  # reversed, lost
        self._age = self._since_evaluation = 0.0
        self._g, self._sigmas = np.ones((3, 3)), np.full((3, 3), UNKNOWN)
        # g of roll, pitch, yaw, (3,): over the window, by the instrument, and by least squares for
        # any cause of the inputs' motion; and since the start of the last change
        self.factor, self.moved, self.since = self._g
        # Their standard deviations, (3,)
        self.sigma, self.moved_sigma, self.since_sigma = self._sigmas
        # Axes whose inputs had no effect when they last moved, (3,)
        self.dead: BoolArray = np.zeros(3, dtype=bool)

    @property
    def reversed(self) -> BoolArray:
        """Axes whose inputs act with the sign opposite to that in use, shape (3,)."""
        return np.asarray(self._log_ratio[0] >= CERTAIN)

    @property
    def recovering(self) -> BoolArray:
        """Dead axes whose inputs show an effect again, not yet surely, shape (3,)."""
        return np.asarray(self.dead & (self._log_ratio[1] < 0.5 * CERTAIN))

    def changed(self, axis: int) -> None:
        """Discard the measurements of an axis, after a change of its inputs."""
        integrals = (part[..., : PLACES[-1], :] for part in (self._total, self._past, self._start))
        for part in (self._recent, self._recent_rest, self._log_ratio, *integrals):
            part[..., axis] = 0.0
        self._g[:, axis], self._sigmas[:, axis] = 1.0, UNKNOWN
        self.dead[axis] = False

    def begin(self, axes: BoolArray) -> None:
        """Set the start of the last change to that of the window, for some axes, (3,)."""
        self._start[:, axes] = self._past[self._oldest][:, axes]
        self.since[axes], self.since_sigma[axes] = self.factor[axes], self.sigma[axes]

    def update(
        self,
        answered: FloatArray,  # answered, made: (3,) As in `Response`, rad/s^3
        made: FloatArray,
        dt: float,  # Time since the last sample, s
        # (3,) As in `Response`. If None, `made` is the instrument: least squares
        demanded: FloatArray | None = None,
        # (3,) Factors in use, relative to `made`
        believed: FloatArray | float = 1.0,
        # answered and made for another delay, if it explains the flight better
        rival: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """Add one sample."""
        demanded = made if demanded is None else demanded
        instruments = np.stack([demanded, np.ones_like(demanded), made])
        sample = np.stack([answered, made])[:, None] * instruments
        keep = math.exp(-dt / CORRELATION)
        self._recent = keep * self._recent + sample
        products = dt**2 * sample[:, None] * (2.0 * self._recent - sample)
        parts = dt * sample[:, ::2], products, dt * demanded**2, np.full(3, dt)
        self._total[:-1] += np.vstack([part.reshape(-1, 3) for part in parts])
        self._age += dt
        significant = np.abs(self.factor - believed) > OUTLIER * self.sigma
        rest = answered - np.where(significant, self.factor, believed) * made
        self._recent_rest = keep * self._recent_rest + rest
        power = dt * rest * (2.0 * self._recent_rest - rest)
        self._rest += dt / min(self._age, REST_MEMORY) * (power - self._rest)
        if rival is not None:
            rival = rival[0], rival[1] * believed
        self._compare(answered, made * believed, dt, rival)
        self._since_evaluation += dt
        if self._since_evaluation >= EVALUATION_PERIOD:
            self._since_evaluation = 0.0
            self._evaluate()
        if rival is not None:
            self._sigmas[:] = UNKNOWN

    def _compare(
        self,
        answered: FloatArray,
        made: FloatArray,
        dt: float,
        rival: tuple[FloatArray, FloatArray] | None,
    ) -> None:
        """Update the likelihood ratios of 'reversed' and 'lost' by one sample."""
        believed, instead = EFFECT_HYPOTHESES
        rest = np.minimum((answered - made) ** 2, (answered - instead * made) ** 2)
        if self._age >= LEAST_TIME:
            rest = np.minimum(rest, OUTLIER**2 * self._noise)
        self._noise = self._noise + min(1.0, dt / NOISE_MEMORY) * (rest - self._noise)
        if self._age < LEAST_TIME:
            return
        # a jerk beyond all hypotheses, as of a breaking surface or a failing motor, is no stronger
        # evidence than the answer of a reversed input
        clipped = np.clip(answered, -np.abs(made), np.abs(made))
        plain = (clipped - believed * made) ** 2
        if rival is not None:  # another delay may explain the residual instead of a fault
            plain = np.minimum(plain, (rival[0] - rival[1]) ** 2)
        ratio = plain - (clipped - instead * made) ** 2
        step = BANDWIDTH / 2.0 * ratio / (2.0 * np.maximum(self._noise, 1e-12))
        most = CERTAIN / LEAST_DETECTION_TIME
        self._log_ratio = np.clip(self._log_ratio + dt * np.clip(step, -most, most), 0.0, CERTAIN)
        lost = self._log_ratio[1]
        self.dead = np.where(self.dead, lost > 0.0, lost >= CERTAIN)

    def _evaluate(self) -> None:
        """Compute g and its sigma over the window and since the last change."""
        self._total[-1] = self._rest
        before = self._past[self._oldest]
        self._g[:2], self._sigmas[:2] = self._solved(before)
        self._g[2], self._sigmas[2] = (found[0] for found in self._solved(self._start))
        self._past[self._oldest] = self._total
        self._oldest = (self._oldest + 1) % EVALUATIONS

    def _solved(self, before: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return g by the instrument and by least squares, and their sigmas, since `before`."""
        parts = np.split(self._total[:-1] - before[:-1], PLACES[:-1])
        sums, products, (demanded,), (time,) = (
            part.reshape(shape) for part, shape in zip(parts, SHAPES, strict=True)
        )
        (answered, made), (aa, am), (ma, mm) = sums, *products
        known = (time > CHANGE_WINDOW - EVALUATION_PERIOD / 2.0) & (made != 0.0)
        made = np.where(known, made, 1.0)
        g = answered / made

        def variance(z: int, g: FloatArray) -> FloatArray:
            return np.asarray(aa[z] - g * (am[z] + ma[z]) + g**2 * mm[z])

        rest = np.maximum(variance(1, g[0]) / np.maximum(time, CHANGE_WINDOW), before[-1])
        spread = np.stack([np.maximum(variance(0, g[0]), rest * demanded), variance(2, g[1])])
        sigma = np.sqrt(np.maximum(spread, 0.0)) / np.abs(made)
        # g of a sum that is zero by chance: its size is as large as its sigma
        known &= sigma < UNKNOWN
        sigma = np.where(known, np.maximum(sigma, LEAST_SIGMA), UNKNOWN)
        return np.where(known, g, 1.0), sigma
