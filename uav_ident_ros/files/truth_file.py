# SPDX-License-Identifier: Apache-2.0
"""True coefficients of a simulated flight, in a file beside its bag."""

from pathlib import Path

import yaml

from uav_ident_ros.files.strict_yaml import UNUSABLE
from uav_ident_ros.identification.structure import Structure

TRUTH_FILE = "truth.yaml"
"""Name of the file in the bag's folder."""


def read_truth(
    bag: Path,  # The bag; the file lies in its folder
    # Structure of the estimates. An aircraft's local derivatives hold at fixed flow angles: they
    # are the truth of a structure with both angles, not of one with `ay` and `az` in their place
    structure: Structure,
) -> dict[str, float]:
    """Read the true coefficients of a flight, by name; empty if there is no valid file."""
    path = (bag if bag.is_dir() else bag.parent) / TRUTH_FILE
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        values = dict(content.get("coefficients") or {})
        if not values and {"alpha", "beta"} <= set(structure.regressors):
            values = dict(content.get("local_derivatives") or {})
        return {name: float(value) for name, value in values.items()}
    except (*UNUSABLE, AttributeError, TypeError, ValueError):
        return {}  # not a file from the simulation
