# SPDX-License-Identifier: Apache-2.0
"""Estimate of the transport delay from command to surface, in closed loop.

Incremental inversion needs the inputs that caused the measured acceleration. With a wrong delay the
loop oscillates: at 20 rad/s, 40 ms are a phase error of 0.8 rad. As in `effectiveness`, the jerk is
compared with the jerk that the inputs should produce,

    jerk_f = g (B u(t - delay))'_f + d xdot_f

for a bank of delays, each with the best g and d of each axis. The delay with the least residuals
replaces the delay in use if their likelihood ratio is large enough. The bank has shorter delays
than the configured one, too: otherwise a delay longer by a period would explain an oscillation
with too long a configured delay. Delays below 20 ms are left out, unless configured: inputs that
respond to gyro noise look like an effect without delay.
"""

import numpy as np

from uav_ident_ros.control.response import BANDWIDTH
from uav_ident_ros.identification.structure import FloatArray

DELAY_STEP = 0.01
"""Spacing of the bank of delays, s: at 15 rad/s a phase of 0.15 rad, two percent of g."""

LATEST = 0.08
"""Largest delay beyond the configured one, s: half a period at 40 rad/s, beyond all laws."""

SOONEST = 0.02
"""Shortest delay of the bank below the configured one, s: gyro noise imitates shorter ones."""

LATENESS_MEMORY = 5.0
"""Time constant of forgetting, s. A delay seldom changes in flight, but a wrong one must be found
before the oscillation grows too large."""

RIVAL, REPLACING = 2.0, 10.0
"""Log-likelihood ratios from which another delay is a rival of the one in use, odds of 7 to 1, and
replaces it, of 22,000 to 1: neighbouring samples correlate more than is accounted for."""

COMPARISON_PERIOD = 0.05
"""Time between comparisons, s: short relative to the memory."""

LEAST_RESIDUAL = 1e-12
"""Lower bound of the residual power over that of the jerk."""


class DelayMeter:
    """Estimator of the delay from a sample to the motion of the surface."""

    def __init__(
        self,
        assumed: float,  # The configured delay, s, in use at the start
    ) -> None:
        steps, sooner = round(LATEST / DELAY_STEP), max(0, round((assumed - SOONEST) / DELAY_STEP))
        self.delays = assumed + DELAY_STEP * np.arange(-sooner, steps + 1)  # (n,) The bank, s
        self.in_use = sooner  # Index of the delay in use
        self.restart()

    @property
    def delay(self) -> float:
        """The delay in use, s."""
        return float(self.delays[self.in_use])

    def restart(self) -> None:
        """Discard the measurements; the delay in use stays."""
        # Sums of the products of made, xdot and answered, for each delay and axis
        self._products = np.zeros((len(self.delays), 3, 3, 3))
        self._weight = self._since = 0.0
        # Index of a delay that is likelier, but not significantly: an apparent change of
        # effectiveness may be due to it
        self.rival: int | None = None

    def update(
        self,
        answered: FloatArray,  # answered, made: (n, 3) As in `Response`, for the `delays`
        made: FloatArray,
        acceleration: FloatArray,  # (3,) The same
        dt: float,  # Time since the last sample, s
    ) -> bool:
        """Add one sample; return whether the delay in use has changed."""
        f = np.stack([made, np.broadcast_to(acceleration, made.shape), answered], axis=-1)
        keep = np.exp(-dt / LATENESS_MEMORY)
        self._products = keep * self._products + dt * f[..., :, None] * f[..., None, :]
        self._weight = keep * self._weight + dt
        self._since += dt
        if self._since < COMPARISON_PERIOD:
            return False
        self._since = 0.0
        likely = self.likelihood()
        best = int(np.argmax(likely))
        lead = likely[best] - likely[self.in_use]
        self.rival = best if RIVAL < lead <= REPLACING else None
        if lead > REPLACING:
            self.in_use = best
        return bool(lead > REPLACING)

    def likelihood(self) -> FloatArray:
        """Return the log-likelihood of each delay, up to a constant."""
        (mm, ma, my), (_, aa, ay), (_, _, yy) = np.moveaxis(self._products, (2, 3), (0, 1))
        rest = ay / np.where(aa > 0.0, aa, 1.0)
        alone = np.maximum(mm - ma**2 / np.where(aa > 0.0, aa, 1.0), 0.0)
        aligned = np.maximum(my - ma * rest, 0.0)  # a reversed effect is no delay
        explained = aligned**2 / np.where(alone > 0.0, alone, 1.0) + rest * ay
        squares = np.where(yy > 0.0, yy, 1.0)
        left = np.maximum(squares - explained, LEAST_RESIDUAL * squares)
        samples = self._weight * BANDWIDTH / 2.0
        return np.asarray(-0.5 * samples * np.log(left).sum(axis=-1))
