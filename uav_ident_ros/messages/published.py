# SPDX-License-Identifier: Apache-2.0
"""What the identifier publishes: names and layout of its entries, for those on either side.

Imports NumPy alone, as controllers do.
"""

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import ROWS, FloatArray, Structure


def coefficients_layout(structure: Structure) -> tuple[tuple[str, int, int], ...]:
    """Label, size and stride of the dimensions of ~/coefficients: its rows, then its columns."""
    rows, n = len(structure.dense_rows), structure.size
    return (
        (",".join(structure.dense_rows), rows, rows * n),
        (",".join(structure.regressors), n, n),
    )


STATE_FIELDS = ("alpha", "beta", "roll", "pitch", "airspeed")
STATE_NAMES = tuple(f"state/{field}" for field in STATE_FIELDS)
"""States of a structure with flow angles beside the rates: rad, rad, rad, rad, m/s."""

FIT_NAMES = ("fit/p", "fit/q", "fit/r")
USABLE_NAME = "verdict/usable"
ROW_USABLE_NAMES = tuple(f"{USABLE_NAME}/{row}" for row in ROWS)


def entry_names(structure: Structure) -> tuple[str, ...]:
    """Names in ~/coefficients_named: coefficients, states, the fit of each axis, verdicts."""
    states = STATE_NAMES if structure.has_flow else ()
    return (*structure.names, *states, *FIT_NAMES, USABLE_NAME, *ROW_USABLE_NAMES)


def dense_coefficients(estimate: Estimate, structure: Structure) -> FloatArray:
    """Matrix of ~/coefficients of an estimate."""
    return estimate.coefficients[: len(structure.dense_rows)]


def named_entries(
    estimate: Estimate, structure: Structure
) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Names, positions and efforts of ~/coefficients_named.

    Positions are values, SI, then the fits in percent, and 1 or 0 for usable. Efforts are one
    standard deviation of each coefficient and flow angle, and 0 for the others.
    """
    verdict = (float(estimate.usable), *map(float, estimate.usable_rows))
    mask, flow = structure.mask, estimate.flow
    states: tuple[float, ...] = ()
    spreads: tuple[float, ...] = ()
    if flow is not None:
        states = tuple(getattr(flow, field) for field in STATE_FIELDS)
        spreads = (flow.alpha_sigma, flow.beta_sigma, 0.0, 0.0, 0.0)
    positions = np.concatenate([estimate.coefficients[mask], states, estimate.fit, verdict])
    rest = np.zeros(len(FIT_NAMES) + len(verdict))
    efforts = np.concatenate([estimate.sigma[mask], spreads, rest])
    return entry_names(structure), positions, efforts
