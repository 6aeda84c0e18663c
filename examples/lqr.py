# SPDX-License-Identifier: Apache-2.0
"""Gains of a rate controller, u = -K x, from coefficients that `replay` or the node saved.

The linear part of the model, xdot = A x + B u with x = p q r and u = de dr da, goes into the
Riccati equation. What the weights mean: a rate of 1 rad/s costs as much as `--input` rad.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import yaml
from scipy.linalg import solve_continuous_are

ROWS, STATES, INPUTS = ("pdot", "qdot", "rdot"), "pqr", ("de", "dr", "da")


def matrices(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return A (3, 3) and B (3, 3) of a coefficients file; what is not in it is 0."""
    known = yaml.safe_load(path.read_text(encoding="utf-8"))["coefficients"]

    def block(columns: str | tuple[str, ...]) -> np.ndarray:
        return np.array(
            [[known.get(f"{row}/{c}", {"value": 0.0})["value"] for c in columns] for row in ROWS]
        )

    return block(STATES), block(INPUTS)


def gains(a: np.ndarray, b: np.ndarray, largest_input: float) -> np.ndarray:
    """Return K (3, 3) for a cost of x^T x + u^T u / largest_input^2."""
    weight = np.eye(3) / largest_input**2
    cost = solve_continuous_are(a, b, np.eye(3), weight)
    return np.linalg.solve(weight, b.T @ cost)


def main() -> None:
    """Print the gains and the poles of the closed loop."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("coefficients", type=Path)
    parser.add_argument("--input", type=float, default=0.2, help="rad (0.2)")
    options = parser.parse_args()
    a, b = matrices(options.coefficients)
    k = gains(a, b, options.input)
    print(f"{'':<4}" + "".join(f"{state:>9}" for state in STATES))
    for name, line in zip(INPUTS, k, strict=True):
        print(f"{name:<4}" + "".join(f"{value:>9.4f}" for value in line))
    for label, matrix in (("open", a), ("closed", a - b @ k)):
        poles = ", ".join(f"{pole:.2f}" for pole in np.sort_complex(np.linalg.eigvals(matrix)))
        print(f"poles, {label}: {poles}")


if __name__ == "__main__":
    main()
