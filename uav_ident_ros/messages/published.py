# SPDX-License-Identifier: Apache-2.0
"""Names and layout of the identifier's outputs, for publishers and clients.

Imports NumPy alone, as clients in a controller do.
"""

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import ROWS, FloatArray, Structure

NAMED = "coefficients_named"
"""Topic of the coefficients by name, in the node's own namespace; it marks an identifier."""


def coefficients_layout(structure: Structure) -> tuple[tuple[str, int, int], ...]:
    """Return label, size and stride of the dimensions of ~/coefficients: rows, columns."""
    rows, n = len(structure.dense_rows), structure.size
    return (
        (",".join(structure.dense_rows), rows, rows * n),
        (",".join(structure.regressors), n, n),
    )


STATE_FIELDS = ("alpha", "beta", "roll", "pitch", "airspeed")
STATE_NAMES = tuple(f"state/{field}" for field in STATE_FIELDS)
"""States beside the rates, of a structure with flow angles: rad, rad, rad, rad, m/s."""

FIT_NAMES = ("fit/p", "fit/q", "fit/r")
USABLE_NAME = "verdict/usable"
ROW_USABLE_NAMES = tuple(f"{USABLE_NAME}/{row}" for row in ROWS)


def entry_names(structure: Structure) -> tuple[str, ...]:
    """Return the names in ~/coefficients_named: coefficients, states, fits, verdicts."""
    states = STATE_NAMES if structure.has_flow else ()
    return (*structure.names, *states, *FIT_NAMES, USABLE_NAME, *ROW_USABLE_NAMES)


def dense_coefficients(estimate: Estimate, structure: Structure) -> FloatArray:
    """Return the matrix of ~/coefficients, (rows, regressors)."""
    return estimate.coefficients[: len(structure.dense_rows)]


def named_entries(
    estimate: Estimate, structure: Structure
) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Return names, positions and efforts of ~/coefficients_named.

    Positions are values (SI), fits (percent) and verdicts (1 is usable, 0 not). Efforts are one
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
