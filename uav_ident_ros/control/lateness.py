# SPDX-License-Identifier: Apache-2.0
"""The delay from command to surface that a flight shows, where it was told wrongly.

Incremental inversion adds to the inputs that made the measured acceleration. If they are not
those, because the delay is another than was told, the loop rings: at 20 rad/s, 40 ms turn what
the inputs did by 0.8 rad. It is measured as the effect is (`effectiveness`): the jerk is
compared with what the inputs should have made,

    jerk_f = g (B u(t - delay))'_f + d xdot_f

for some delays at a time, each with the g and d of each axis that suit it best. The delay with the
least residuals is believed once it is surely likelier than the present one. Shorter ones than was
told are compared, too: otherwise a delay that is a whole turn later would explain a loop that rings
because its inputs act sooner than believed. None is shorter than 20 ms, but one that was told: gyro
noise that the inputs answer looks like an effect without any delay.
"""

import numpy as np

from uav_ident_ros.control.response import BANDWIDTH
from uav_ident_ros.identification.structure import FloatArray

STEP = 0.01
"""Between the delays that are compared, s: at 15 rad/s a turn by 0.15 rad, two percent of g."""

LATEST = 0.08
"""Largest delay beyond the told one, s: half a turn at 40 rad/s, faster than any of the laws."""

SOONEST = 0.02
"""Shortest delay that is compared if a longer one was told, s: gyro noise looks like none."""

MEMORY = 5.0
"""Time in which the weight of what was measured falls to 1 / e, s: a delay is no fault that comes
at once, but one that makes the loop ring has to be found before the aircraft is lost."""

DOUBT, SURE = 2.0, 10.0
"""Log-likelihood ratios from which on another delay puts the believed one in doubt, odds of 7 to 1,
and takes its place, of 22,000 to 1: neighbouring samples tell more of the same than is counted."""

PERIOD = 0.05
"""Time between comparisons, s: short beside the memory."""

NOTHING = 1e-12
"""Residuals over the jerk's square that count as none."""


class DelayMeter:
    """Delay from a sample to the surface that its command moves, as measured."""

    def __init__(
        self,
        assumed: float,  # What was told, s, to start with
    ) -> None:
        steps, sooner = round(LATEST / STEP), max(0, round((assumed - SOONEST) / STEP))
        self.delays = assumed + STEP * np.arange(-sooner, steps + 1)  # (n,) Compared, s
        self.believed = sooner  # Which of them it is
        self.restart()

    @property
    def delay(self) -> float:
        """The one that is believed, s."""
        return float(self.delays[self.believed])

    def restart(self) -> None:
        """Forget what was measured, but not what is believed."""
        # Of each delay and axis the products of made, xdot and answered with one another, summed up
        self._products = np.zeros((len(self.delays), 3, 3, 3))
        self._weight = self._since = 0.0
        # Another delay that explains the flight better, counted, if not surely: then what looks
        # like another effect of the inputs may be the delay's
        self.rival: int | None = None

    def update(
        self,
        answered: FloatArray,  # answered, made: (n, 3) As in `Response`, for the `delays`
        made: FloatArray,
        acceleration: FloatArray,  # (3,) The same
        dt: float,  # Time since the last sample, s
    ) -> bool:
        """Take one sample; return whether another delay is believed from now on."""
        f = np.stack([made, np.broadcast_to(acceleration, made.shape), answered], axis=-1)
        keep = np.exp(-dt / MEMORY)
        self._products = keep * self._products + dt * f[..., :, None] * f[..., None, :]
        self._weight = keep * self._weight + dt
        self._since += dt
        if self._since < PERIOD:
            return False
        self._since = 0.0
        likely = self.likelihood()
        best = int(np.argmax(likely))
        lead = likely[best] - likely[self.believed]
        self.rival = best if DOUBT < lead <= SURE else None
        if lead > SURE:
            self.believed = best
        return bool(lead > SURE)

    def likelihood(self) -> FloatArray:
        """Return the log-likelihood of each delay but for a constant."""
        (mm, ma, my), (_, aa, ay), (_, _, yy) = np.moveaxis(self._products, (2, 3), (0, 1))
        rest = ay / np.where(aa > 0.0, aa, 1.0)
        alone = np.maximum(mm - ma**2 / np.where(aa > 0.0, aa, 1.0), 0.0)
        aligned = np.maximum(my - ma * rest, 0.0)  # an effect of the other sign is no delay
        explained = aligned**2 / np.where(alone > 0.0, alone, 1.0) + rest * ay
        squares = np.where(yy > 0.0, yy, 1.0)
        left = np.maximum(squares - explained, NOTHING * squares)
        samples = self._weight * BANDWIDTH / 2.0
        return np.asarray(-0.5 * samples * np.log(left).sum(axis=-1))
