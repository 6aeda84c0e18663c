# SPDX-License-Identifier: Apache-2.0
"""A custom estimator: the instrumental variable with a limit on each coefficient's step.

``python3 examples/own_estimator.py bags/c172p`` replays a bag with and without it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.estimators.recursive import RecursiveRegression
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression, RowSamples
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.offline.run import run_over

LARGEST_STEP = 0.003
"""Largest step of a coefficient in an update, standard deviations."""


class Gentle(RecursiveRegression):
    """Instrumental variable with steps of at most `LARGEST_STEP` sigma."""

    def __init__(self, settings: Settings, start: Start) -> None:
        super().__init__(start, settings, instrumental=True)

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Update as the instrumental variable does, with limited steps."""
        before = self.coefficients
        super().update(samples, rows, white, weight)
        largest = LARGEST_STEP * self.sigma
        self.coefficients = before + np.clip(self.coefficients - before, -largest, largest)


def main(bag: Path) -> None:
    """Compare the scores with and without it."""
    values = load_parameters(bag / "identifier.yaml", "identifier")
    compared: dict[str, dict[str, Any]] = {"own": {"estimator": Gentle}, "without": {}}
    for label, parts in compared.items():
        run = run_over(bag, values, **parts)
        published = np.array([e.coefficients for e in run.estimates[len(run.estimates) // 2 :]])
        steps = np.abs(np.diff(published[:, *run.structure.index("pdot/da")])).max()
        fit = run.score()["last_40_percent"].model
        print(f"{label}: largest step of pdot/da {steps:.4f} 1/s^2, fit {np.round(fit, 1)} %")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", type=Path)
    main(parser.parse_args().bag)
