# SPDX-License-Identifier: Apache-2.0
"""A custom gate: learning pauses beyond a load factor, where a wing is not linear.

``python3 examples/own_gate.py bags/c172p`` replays a bag with and without it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.gates import Gate, Look
from uav_ident_ros.offline.run import run_over

LARGEST_LOAD = 1.3 * 9.80665
"""Specific force along the Imu's z axis above which the gate is closed, m/s^2."""


def overloaded(look: Look) -> str:
    """Return the reason to pause at a tick; empty if there is none."""
    if not len(look.samples) or np.abs(look.samples[:, 5]).max() < LARGEST_LOAD:
        return ""
    return "the wing carries more than 1.3 g"


GATE = Gate("load", setting="", check=overloaded)
"""Name, setting of the threshold (none), and predicate."""


def main(bag: Path) -> None:
    """Compare the scores with and without it."""
    values = load_parameters(bag / "identifier.yaml", "identifier")
    compared: dict[str, dict[str, Any]] = {"own": {"gates": [GATE]}, "without": {}}
    for label, parts in compared.items():
        run = run_over(bag, values, **parts)
        shares = {
            name: f"{cost.share:.0%}"
            for name, cost in run.identifier.supervisor.gates.costs().items()
        }
        print(f"{label}: share of the flight that each gate cost: {shares}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", type=Path)
    main(parser.parse_args().bag)
