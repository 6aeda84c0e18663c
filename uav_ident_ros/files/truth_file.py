# SPDX-License-Identifier: Apache-2.0
"""The true coefficients that lie beside the bag of a simulated flight."""

from __future__ import annotations

from pathlib import Path

import yaml

from uav_ident_ros.identification.structure import Structure

TRUTH_FILE = "truth.yaml"
"""Name of the file in the bag's folder."""


def read_truth(bag: Path, structure: Structure) -> dict[str, float]:
    """Return the true coefficients by name, SI; empty where nothing comparable is known.

    The local derivatives of an aircraft hold at fixed angles of attack and sideslip: they compare
    with the coefficients of a structure that has both angles, not with those of one in which
    `ay` and `az` stand for them.

    Parameters
    ----------
    bag : Path
        The bag, a folder.
    structure : Structure
        Structure of the coefficients to compare with.
    """
    path = bag / TRUTH_FILE
    if not path.is_file():
        return {}
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    known = content.get("coefficients", {})
    if {"alpha", "beta"} <= set(structure.regressors):
        known = known or content.get("local_derivatives", {})
    return {str(name): float(value) for name, value in known.items()}
