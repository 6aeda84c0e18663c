# SPDX-License-Identifier: Apache-2.0
"""Results of the identifier, and saved coefficients."""

from __future__ import annotations

from dataclasses import dataclass

from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.structure import FloatArray


@dataclass(frozen=True)
class CoefficientSet:
    """Coefficients of a structure with their uncertainty.

    Parameters
    ----------
    structure : str
        Name of the structure.
    values : (R, n) array
        A, SI units, body axes FRD; zero where the structure has no coefficient.
    sigma : (R, n) array
        Standard deviations; 0 for fixed and absent coefficients.
    t_ns : int
        Message time at which they were valid, nanoseconds; 0 if unknown.
    """

    structure: str
    values: FloatArray
    sigma: FloatArray
    t_ns: int = 0


@dataclass(frozen=True)
class Estimate:
    """State of the identification at a tick.

    Parameters
    ----------
    t_ns : int
        Message time of the tick, nanoseconds.
    coefficients : (R, n) array
        A_m, SI units, body axes FRD.
    sigma : (R, n) array
        Standard deviation of each coefficient; 0 for the fixed ones; that of the prior before there
        is information.
    predicted_rates : (3,) array
        State x_m of the identified model at the tick, rad/s, in the Imu's own axes.
    prediction_error : (3,) array
        Newest measured rates at the tick, unfiltered, minus `predicted_rates`; rad/s.
    fit : (3,) array
        Running 1-second prediction fit of p, q, r in percent; 0 until there is one.
    adapting : bool
        Whether the coefficients moved, or could have moved, at this tick.
    usable : bool
        Whether a controller may act on the coefficients of all moment rows.
    usable_rows : (3,) tuple of bool
        The same for each of the rows pdot, qdot, rdot.
    state : str
        One word: ``waiting``, ``learning``, ``converged``, ``paused`` or ``fault``.
    reason : str
        Why it is not adapting, or not usable; empty if neither.
    flow : FlowState or None
        Attitude, flow angles and airspeed; None for a structure without flow angles.
    """

    t_ns: int
    coefficients: FloatArray
    sigma: FloatArray
    predicted_rates: FloatArray
    prediction_error: FloatArray
    fit: FloatArray
    adapting: bool
    usable: bool
    usable_rows: tuple[bool, bool, bool]
    state: str
    reason: str
    flow: FlowState | None = None
