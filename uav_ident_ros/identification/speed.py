# SPDX-License-Identifier: Apache-2.0
"""Speed scaling: coefficients that hold across flight speeds.

With constant aerodynamic coefficients, moments grow with the dynamic pressure, thus with V^2 of the
airspeed V. So do control derivatives, and a constant moment, which is that of an input off its
trim. Damping grows with V, since the flow angle that a rate causes falls with V. The estimator uses
regressors scaled by V / V_ref and its square, and thus identifies the coefficients at V_ref.
Published coefficients hold at the speed flown. V is the measured airspeed without its noise.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.samples import NS, SampleBuffer
from uav_ident_ros.identification.scales import DOUBTLESS, MEMORY, RESPONSE_TIME
from uav_ident_ros.identification.settings import AirspeedSettings, Settings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    LAST_COLUMNS,
    OWN_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    STRUCTURES,
    FloatArray,
    Structure,
)

LARGEST_SPEED_RATIO = 3.0
"""Largest ratio of airspeed and reference, or its inverse, at which the scaling holds: at lower
speed the flow separates, at higher speed the measurement is wrong."""

BANDWIDTHS = np.append(np.inf, 2.0 ** np.arange(6, -1, -1) / RESPONSE_TIME)
"""Bandwidths of the filters of the airspeed, 1/s: the samples as they are, then from 32 by halves
to that of a response. One of them is within a factor of 1.4 of the best."""

SILENCE = f"no airspeed has arrived in the last {RESPONSE_TIME:g} s"
"""Reason not to learn, and not to use the coefficients."""


def slowest(settings: AirspeedSettings) -> float:
    """Return the lowest airspeed at which the scaling holds, m/s."""
    return settings.reference / LARGEST_SPEED_RATIO


def unmeasured(settings: Settings) -> str:
    """Return the problem if the airspeed is neither measured nor configured; else empty."""
    airspeed, default = settings.airspeed, AirspeedSettings().reference
    needed = STRUCTURES[settings.structure].has_flow
    if airspeed.type or airspeed.reference != default or not needed:
        return ""
    return (
        f"no airspeed is measured, and 'airspeed.reference' is the default, {default:g} m/s: set "
        "it to the speed flown, or set 'airspeed.type' (a reference 2.6 times too low costs 30 % "
        "of qdot/de)"
    )


class AirspeedFilter:
    """Airspeed without the noise of its sensor.

    In gusts the airspeed is a random walk, and its sensor adds white noise. The Kalman filter of
    that is a low-pass of first order; its bandwidth follows from the ratio of both. Of filters with
    several bandwidths the one with the smallest innovations is in use. Samples without noise pass
    as they are. A step that no noise explains is a new beginning.

    References
    ----------
    A. C. Harvey, "Forecasting, Structural Time Series Models and the Kalman Filter", 1989: the
    local level model.
    """

    def __init__(self) -> None:
        self._levels = np.zeros(len(BANDWIDTHS))  # m/s
        # Sums over the samples: squares of the innovations, m^2/s^2, and their number
        self._squares, self._count = np.zeros(len(BANDWIDTHS)), 0.0
        self.restart()

    def restart(self) -> None:
        """Begin a new time base: the innovations so far are kept."""
        self.t_ns: int | None = None  # Stamp of the newest sample, ns
        self.airspeed = self.sigma = 0.0  # True airspeed and its standard deviation, m/s

    def add(self, t_ns: int, airspeed: float) -> None:
        """Add a sample of the airspeed, m/s."""
        before, self.t_ns = self.t_ns, t_ns
        innovations = airspeed - self._levels
        best = int(np.argmin(self._squares))
        if before is None:
            keep = np.zeros_like(innovations)
        elif self._count * innovations[best] ** 2 > DOUBTLESS**2 * self._squares[best]:
            keep, self._squares = np.zeros((2, len(BANDWIDTHS)))
            self._count = 0.0
        else:
            elapsed = (t_ns - before) * NS
            keep, fade = np.exp(-elapsed * BANDWIDTHS), np.exp(-elapsed / MEMORY)
            self._squares = fade * self._squares + innovations**2
            self._count = fade * self._count + 1.0
            best = int(np.argmin(self._squares))
        self._levels = airspeed - keep * innovations
        self.airspeed = float(self._levels[best])
        # In the steady state, with the gain 1 - keep
        variance = keep[best] * (1.0 - keep[best]) * self._squares[best] / max(self._count, 1.0)
        self.sigma = float(np.sqrt(variance))


class SpeedScaling:
    """Scale of each regressor at the airspeed flown."""

    def __init__(self, settings: AirspeedSettings, structure: Structure) -> None:
        self.enabled = settings.type != ""
        self.samples = SampleBuffer(1)  # True airspeed, m/s
        self._reference, self._slowest = settings.reference, slowest(settings)
        self._power: FloatArray = np.zeros(structure.mask.shape)
        self._power[:, RATE_COLUMNS] = 1.0
        self._power[:, INPUT_COLUMNS] = 2.0
        self._power[: len(ROWS)][structure.constants[: len(ROWS)]] = 2.0
        self._power[: len(ROWS), OWN_COLUMNS] = [own.power for own in structure.own]
        if structure.has_flow:
            self._power[:, LAST_COLUMNS] = 2.0
            # so that its product with the slope of ay grows with V, as the other columns of p
            self._power[structure.row_labels.index("betadot"), RATE_COLUMNS] = -1.0
        self.known = not self.enabled  # Whether the scale holds at the airspeed flown
        self.scale: FloatArray = np.ones_like(self._power)  # (R, n) Factor of each coefficient
        self.newest: float | None = None  # Newest sample, m/s
        self.airspeed: float | None = None  # Without the noise, m/s
        self._share = 0.0  # Its standard deviation, relative
        self._filter = AirspeedFilter()
        self.restart()

    def restart(self) -> None:
        """Begin a new time base: no airspeed has arrived since."""
        self.samples.clear()
        self._filter.restart()
        # Problem if an airspeed was measured, but none lately; empty if there is none
        self.silence = "" if self.newest is None else SILENCE
        # Whether the scale is valid: no airspeed is measured, or it is high enough and up to date
        self.believed = self.newest is None

    def update(self, t_ns: int) -> None:
        """Update the scale with the airspeeds in use at the tick `t_ns`."""
        stamps, filtered = self.samples.t, self._filter
        if self.enabled and len(stamps):
            values = self.samples.v[:, 0].tolist()
            new = 0 if filtered.t_ns is None else self.samples.after(filtered.t_ns)
            for k in range(new, len(values)):
                filtered.add(int(stamps[k]), values[k])
            self.newest, self.airspeed = values[-1], filtered.airspeed
            ratio = self.airspeed / self._reference
            ratio = min(max(ratio, 1.0 / LARGEST_SPEED_RATIO), LARGEST_SPEED_RATIO)
            self.scale = ratio**self._power
            self._share = filtered.sigma / (ratio * self._reference)
            self.known = True
            self.samples.trim(t_ns)
        silent = not len(stamps) or (t_ns - stamps[-1]) * NS > RESPONSE_TIME
        if self.newest is not None:
            self.silence = SILENCE if silent else ""
            self.believed = not silent and self.newest >= self._slowest

    def widened(self, sigma: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Return standard deviations with that of the scale, (R, n); 0 if fixed."""
        by_scale = self._share * self._power * coefficients
        return np.hypot(sigma, by_scale, where=sigma > 0.0, out=np.zeros_like(sigma))
