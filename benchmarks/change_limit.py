# SPDX-License-Identifier: Apache-2.0
"""Cramér-Rao bound of a halved control derivative: ``python benchmarks/change_limit.py``.

The bound is that of the best case. The time of the change is known, and so are all other
coefficients and the statistics of gusts and noise. For each row, with the state ``[x, d, a]``
(rate, gust, control derivative),

    x' = A_ii x + a u + d,    d' = -d / T + w,    a' = 0,    y = x + noise,

a Kalman filter's variance of ``a`` is that bound. Printed are the standard deviation relative to
the new value, and the probability that an estimate at the bound is within 15 %. The probability
that it stays there is smaller.
"""

import math

import cases
import flights
import numpy as np

from uav_ident_ros.identification.filters import expm
from uav_ident_ros.identification.structure import INPUT_COLUMNS, STRUCTURES, FloatArray

TIMES = (5.0, 10.0, 20.0)
"""Times after the change, s."""

NEAR = 0.15
SEEDS = 5
"""Number of seeds of the inputs; the bound depends on the inputs."""


def bound(name: str, coefficient: str, seed: int) -> FloatArray:
    """Return the bound's standard deviations at `TIMES`, relative to the new value."""
    definition = flights.definition(name)
    flight = flights.load_flight(name, seed)
    structure = STRUCTURES[flight.structure]
    i, j = structure.index(coefficient)
    assert flight.coefficients is not None
    damping = flight.coefficients[i, structure.regressors.index("pqr"[i])]
    new = 0.5 * flight.coefficients[i, j]
    gusts, sensors = definition["gusts"], definition["sensors"]
    rate, memory = sensors["rate"], gusts["correlation_time"]
    start = flight.changes[0].time
    t = start + np.arange(1, round(max(TIMES) * rate) + 1) / rate
    held = np.searchsorted((flight.actuator_t_ns - flight.t_ns[0]) * 1e-9, t, side="right") - 1
    u = flight.inputs[held, j - INPUT_COLUMNS.start]
    covariance = np.diag([sensors["gyro_noise"] ** 2, gusts["rms"] ** 2, (2.0 * new) ** 2])
    found = []
    for now in u:
        system = np.array([[damping, 1.0, now], [0.0, -1.0 / memory, 0.0], [0.0, 0.0, 0.0]])
        step = expm(system / rate)
        covariance = step @ covariance @ step.T
        covariance[1, 1] += gusts["rms"] ** 2 * (1.0 - step[1, 1] ** 2)
        gain = covariance[:, 0] / (covariance[0, 0] + sensors["gyro_noise"] ** 2)
        covariance = covariance - np.outer(gain, covariance[0])
        found.append(math.sqrt(covariance[2, 2]) / abs(new))
    return np.array([found[round(time * rate) - 1] for time in TIMES])


def main() -> None:
    """Print a line for each surface."""
    print(f"{'flight':34}" + "".join(f"{f'after {t:g} s':>22}" for t in TIMES))
    for surface, coefficient in cases.PRIMARY.items():
        name = f"exact_halved_{surface}_gusts_05"
        sigma = np.median([bound(name, coefficient, s) for s in range(1, SEEDS + 1)], axis=0)
        cells = [
            f"{100 * s:.1f} %, near {100 * math.erf(NEAR / s / math.sqrt(2)):.0f} %" for s in sigma
        ]
        print(f"{name:34}" + "".join(f"{cell:>22}" for cell in cells))


if __name__ == "__main__":
    main()
