# SPDX-License-Identifier: Apache-2.0
"""Estimates for tests, and messages of these estimates."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages.published import named_entries


def estimate_of(
    values: FloatArray, sigma: FloatArray | None = None, *, usable: bool = True, **other: Any
) -> Estimate:
    """Return an estimate of these coefficients; other fields are zero, empty, or as `usable`."""
    three = np.zeros(3)
    own: dict[str, Any] = {
        "t_ns": 1, "predicted_rates": three, "prediction_error": three, "fit": three,
        "adapting": True, "usable_rows": (usable,) * 3, "state": "learning", "reason": "",
    }  # fmt: skip
    spread = np.zeros_like(values) if sigma is None else sigma
    return Estimate(coefficients=values, sigma=spread, usable=usable, **{**own, **other})


def as_message(estimate: Estimate, structure: Structure) -> Any:
    """Return the identifier's message of an estimate, as attributes."""
    names, positions, efforts = named_entries(estimate, structure)
    seconds, rest = divmod(estimate.t_ns, 10**9)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=rest)),
        name=list(names),
        position=positions.tolist(),
        effort=efforts.tolist(),
    )
