# SPDX-License-Identifier: Apache-2.0
"""What settings that the flight shows to be off do to the derivatives: a delay, a mounting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.linearisation import damping
from uav_ident_ros.identification.structure import (
    MAIN_COLUMNS,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)

_MOMENTS = np.arange(len(ROWS))


@dataclass(frozen=True)
class SetupError:
    """What one setting that is off does to the moment rows."""

    errors: FloatArray  # (3, n) By how much it falsifies each coefficient, SI
    reason: str  # What is off, and the setting that would be right

    def denies(self, coefficients: FloatArray, t_ratio: float) -> BoolArray:
        """Whether main control derivatives are falsified by more than 1 in `t_ratio`, (3,)."""
        main = _MOMENTS, MAIN_COLUMNS
        return np.asarray(t_ratio * self.errors[main] > np.abs(coefficients[main]))


def delay_error(
    estimate: DelayEstimate, delay: float, structure: Structure, values: FloatArray, airspeed: float
) -> SetupError:
    """Return what a delay in use, s, does that the flight shows to be off.

    Before an axis that settles with a, an input that comes T later than told looks like one of an
    effect of 1 / (1 + a T): to first order the row is off by ``a T``.
    """
    share = np.abs(estimate.off(delay) * damping(structure, values, airspeed))
    return SetupError(share[:, None] * np.abs(values[_MOMENTS]), estimate.contradiction(delay))


def height_error(height: float, structure: Structure, values: FloatArray) -> SetupError:
    """Return what an accelerometer does that is higher, m, than `imu.lever_arm` says.

    It measures ``ay + h pdot``. A row that takes sideslip from ay, with ``L = L_beta / Y_beta``, is
    off by ``L h`` times the row of pdot.
    """
    flow = structure.flow[0]
    slope = values[_MOMENTS, flow.angle] / values[flow.force, flow.angle]
    errors = np.abs(height * slope[:, None] * values[0])
    word = "above" if height > 0.0 else "below"
    return SetupError(
        errors,
        f"the accelerometer measures rolling as if it were {abs(height):.2f} m {word} where "
        "'imu.lever_arm' puts it: set that to its position from the centre of gravity",
    )
