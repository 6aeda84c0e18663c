# SPDX-License-Identifier: Apache-2.0
"""What settings that the flight shows to be off do to the derivatives: a delay, a mounting.

Sigma is to cover it, and where it is much, the verdict names the setting.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.linearisation import damping
from uav_ident_ros.identification.structure import (
    MAIN_DERIVATIVES,
    ROWS,
    FloatArray,
    Structure,
)


class SetupError(NamedTuple):
    """What one setting that is off does to the moment rows."""

    errors: FloatArray  # (3, n) By how much it falsifies each coefficient, SI
    reason: str  # What is off, and the setting that would be right


class SetupErrors:
    """Follows which settings are off, and what that does.

    Parameters
    ----------
    structure : Structure
        Structure of the coefficients; without flow angles nothing is found, since every gust
        looks like a late input.
    airspeed : float
        True airspeed at which the coefficients hold, m/s.
    """

    def __init__(self, structure: Structure, airspeed: float) -> None:
        self._structure, self._airspeed = structure, airspeed
        self._found: list[SetupError] = []

    def look(
        self,
        values: FloatArray,
        estimate: DelayEstimate,
        delay: float,
        height: float,
        *,
        lag_is_told: bool,
    ) -> None:
        """Look at what the flight shows by now.

        Parameters
        ----------
        values : (R, n) array
            Coefficients.
        estimate : DelayEstimate
            What the flight says about the delay.
        delay : float
            Delay in use, s.
        height : float
            Height of the accelerometer above where it is said to be, m; 0 for none.
        lag_is_told : bool
            Whether the lag in use is known, or a found delay may stand for another.
        """
        self._found = []
        if not self._structure.has_flow:
            return
        if estimate.off(delay):
            self._found.append(self._delay_error(values, estimate, delay))
        elif estimate.sure and not lag_is_told:
            self._found.append(self._lag_error(values, estimate.hidden))
        if height:
            self._found.append(self._height_error(values, height))

    def widened(self, sigma: FloatArray) -> FloatArray:
        """Return standard deviations (R, n) that cover it; 0 where a coefficient is fixed."""
        sigma = sigma.copy()
        moments = sigma[: len(ROWS)]
        for found in self._found:
            np.hypot(moments, found.errors, where=moments > 0.0, out=moments)
        return sigma

    def denied(self, values: FloatArray, t_ratio: float) -> list[str]:
        """Return for each moment row what falsifies it by more than 1 in `t_ratio`, if any."""
        reasons = [""] * len(ROWS)
        for found in self._found:
            far = t_ratio * found.errors[MAIN_DERIVATIVES] > np.abs(values[MAIN_DERIVATIVES])
            for row in np.flatnonzero(far).tolist():
                reasons[row] = reasons[row] or found.reason
        return reasons

    def _delay_error(self, values: FloatArray, estimate: DelayEstimate, delay: float) -> SetupError:
        """Return what a delay in use, s, does that the flight shows to be off.

        Before an axis that settles with a, an input that comes T later than told looks like one of
        an effect of 1 / (1 + a T): to first order the row is off by ``a T``.
        """
        off = estimate.off(delay)
        return SetupError(self._late(values, off), estimate.contradiction(delay))

    def _lag_error(self, values: FloatArray, hidden: float) -> SetupError:
        """Return what a servo lag, s, does that a delay stands for.

        The delay makes the input as late; what the lag takes from it, ``1 / (1 + a T)``, stays.
        """
        return SetupError(
            self._late(values, hidden),
            f"a servo lag of {1e3 * hidden:.0f} ms would predict as well as the delay that was "
            "found: set 'actuators.time_constant', or inject on purpose ('excitation')",
        )

    def _late(self, values: FloatArray, time: float) -> FloatArray:
        """By how much an input that comes so late, s, falsifies the moment rows, (3, n)."""
        share = np.abs(time * damping(self._structure, values, self._airspeed))
        return np.asarray(share[:, None] * np.abs(values[: len(ROWS)]))

    def _height_error(self, values: FloatArray, height: float) -> SetupError:
        """Return what an accelerometer does that is higher, m, than `imu.lever_arm` says.

        It measures ``ay + h pdot``. A row that takes sideslip from ay, with
        ``L = L_beta / Y_beta``, is off by ``L h`` times the row of pdot.
        """
        flow = self._structure.flow[0]
        slope = values[: len(ROWS), flow.angle] / values[flow.force, flow.angle]
        errors = np.abs(height * slope[:, None] * values[0])
        word = "above" if height > 0.0 else "below"
        return SetupError(
            errors,
            f"the accelerometer measures rolling as if it were {abs(height):.2f} m {word} where "
            "'imu.lever_arm' puts it: set that to its position from the centre of gravity",
        )
