# SPDX-License-Identifier: Apache-2.0
"""A gate of your own: learning pauses beyond a load factor, where a wing is not linear.

``python3 examples/own_gate.py bags/c172p`` replays a bag with it, and without.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.gates import Gate, Look
from uav_ident_ros.offline.run import run_over

LARGEST_LOAD = 1.3 * 9.80665
"""Specific force along the Imu's z axis beyond which nothing is learned, m/s^2."""


def overloaded(look: Look) -> str:
    """Return why to pause at a tick; empty if there is no reason."""
    if not len(look.samples) or np.abs(look.samples[:, 5]).max() < LARGEST_LOAD:
        return ""
    return "the wing carries more than 1.3 g"


GATE = Gate("load", setting="", check=overloaded)
"""Its name, the setting that moves its threshold if there is one, and what it looks at."""


def main(bag: Path) -> None:
    """Compare the two."""
    values = load_parameters(bag / "identifier.yaml", "identifier")
    compared: dict[str, dict[str, Any]] = {"own": {"gates": [GATE]}, "without": {}}
    for words, parts in compared.items():
        run = run_over(bag, values, **parts)
        shares = {
            name: f"{cost.share:.0%}"
            for name, cost in run.identifier.supervisor.gates.costs().items()
        }
        print(f"{words}: share of the flight that each gate cost: {shares}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
