# SPDX-License-Identifier: Apache-2.0
"""A custom regressor: an aileron that loses effect as it is deflected further.

``python3 examples/own_regressor.py bags/c172p`` replays a bag with and without it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.prior import INPUT_SIGMA
from uav_ident_ros.identification.structure import STRUCTURES, Regressor
from uav_ident_ros.offline.run import run_over

SOFT = Regressor(
    label="da|da|",
    value=lambda p, q, r, de, dr, da, dth: da * abs(da),
    sigma=INPUT_SIGMA,
)
"""The regressor: its name, its value, and the prior standard deviation of its coefficients."""

OWN = STRUCTURES["flight_dynamics"].extended("soft_aileron", {"pdot": [SOFT]})
"""The default structure with this regressor in the row of roll."""

STRUCTURES[OWN.name] = OWN
"""From here on it is a choice of the setting ``structure``."""


def main(bag: Path) -> None:
    """Compare the coefficient with its sigma, and the scores with and without it."""
    values = load_parameters(bag / "identifier.yaml", "identifier")
    for name in (OWN.name, "flight_dynamics"):
        run = run_over(bag, {**values, "structure": name})
        last, fit = run.estimates[-1], run.score()["last_40_percent"].model
        print(f"{name}: fit {np.round(fit, 1)} %")
        if name == OWN.name:
            index = OWN.index("pdot/da|da|")
            value, sigma = last.coefficients[index], last.sigma[index]
            print(
                f"pdot/da|da| is {value:.1f} +- {sigma:.1f}, a t-ratio of {abs(value) / sigma:.1f}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", type=Path)
    main(parser.parse_args().bag)
