# SPDX-License-Identifier: Apache-2.0
"""One online pass beside an offline fit: ``python benchmarks/free_output_error.py [FLIGHT ...]``.

The offline fit minimises the error of the score: that of free predictions over 5 s, in the first
60 % of the flight. It uses `scipy.optimize.least_squares`, with structure, prior and flow states of
the online pass. Both are scored over the last 40 %, at 1, 3 and 5 s, p / q / r.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import bench
import cases
import numpy as np
from free_prediction import triple
from output_error import TRAINING_PART
from scipy.optimize import least_squares

from uav_ident_ros.identification.model import flight_derivative, integrate
from uav_ident_ros.identification.prior import start_from
from uav_ident_ros.identification.structure import CONSTANT_COLUMN, INPUT_COLUMNS, FloatArray

HORIZON, APART = 5.0, 2.5
"""Length of the fitted windows, and time between their starts, s."""

SETTLED = 15.0
"""Time after which the online pass's flow states serve as initial ones, s."""

STEP = 1e-4
"""Step of the difference quotient, relative to the coefficient or to 1."""

LARGEST = 3.0
"""Limit of the rates and angles of a diverging prediction, rad/s and rad."""

FLIGHTS = ("c172p_calm", "t37_calm", "ov10_calm")


@dataclass(frozen=True)
class Windows:
    """Measured signals over W windows of m cells."""

    h: float  # Width of a cell, s
    x: FloatArray  # (m + 1, 3, W) Rates at the edges, rad/s
    u: FloatArray  # (m, 4, W) Inputs
    start: FloatArray  # (8, W) Initial state, from the online pass
    airspeed: FloatArray  # (W,) m/s


def windows(case: cases.Case, track: cases.Track) -> Windows:
    """Cut the training part of a flight into windows."""
    assert track.flow is not None
    last = TRAINING_PART * track.time[-1]
    rates, inputs, start, airspeed = [], [], [], []
    wanted = SETTLED
    blocks = case.blocks(track.settings)
    m = round(HORIZON / blocks[0].h)
    for k, time in enumerate(track.time.tolist()):
        if time < wanted or time + HORIZON > last:
            continue
        for block in blocks:
            i = int(np.searchsorted(block.t_ns, track.t_ns[k]))
            if block.t_ns[0] <= track.t_ns[k] and i + m < len(block.t_ns):
                rates.append(block.x[i : i + m + 1])
                inputs.append(block.u[i : i + m])
                start.append(np.concatenate((block.x[i], track.flow[k, :-1])))
                airspeed.append(track.flow[k, -1])
                wanted = time + APART
    x, u = (np.array(part).transpose(1, 2, 0) for part in (rates, inputs))
    return Windows(blocks[0].h, x, u, np.array(start).T, np.array(airspeed))


def predicted(a: FloatArray, flown: Windows) -> FloatArray:
    """Return the rates that P models a, (7, n, P), predict in the windows, (m + 1, 3, P, W)."""
    models = a[..., None]
    state = [np.broadcast_to(part, (a.shape[2], part.size)) for part in flown.start]

    def steps() -> Iterator[tuple[object, object, object, float]]:
        none = np.zeros(1)
        for u in flown.u:
            rows = (models[:, INPUT_COLUMNS] * u[:, None]).sum(axis=1) + models[:, CONSTANT_COLUMN]
            drive = [*rows, 1.0 / flown.airspeed, none, none, none]
            yield drive, drive, drive, flown.h

    out = [np.array(state[:3])]
    with np.errstate(over="ignore", invalid="ignore"):
        for found in integrate(flight_derivative(models), state, steps()):
            out.append(np.array(found[:3]))
    return np.nan_to_num(np.clip(np.array(out), -LARGEST, LARGEST), nan=LARGEST)


def fit(case: cases.Case, track: cases.Track) -> FloatArray:
    """Fit the structure of an online pass offline, (7, n), from its coefficients as the start."""
    start, flown = start_from(track.settings), windows(case, track)
    free = start.free
    weight = 1.0 / flown.x.std(axis=(0, 2))

    def residuals(thetas: FloatArray) -> FloatArray:
        """Return the residuals of coefficients (k, P), then those of the prior, (r, P)."""
        a = np.repeat(start.values[:, :, None], thetas.shape[1], axis=2)
        a[free] = thetas
        error = (predicted(a, flown) - flown.x[:, :, None]) * weight[:, None, None]
        prior = (thetas - start.values[free][:, None]) / start.sigma[free][:, None]
        return np.concatenate((error.transpose(0, 1, 3, 2).reshape(-1, thetas.shape[1]), prior))

    def jacobian(theta: FloatArray) -> FloatArray:
        step = STEP * np.maximum(np.abs(theta), 1.0)
        moved = residuals(np.column_stack([theta, theta[:, None] + np.diag(step)]))
        return np.asarray((moved[:, 1:] - moved[:, :1]) / step)

    learned = track.coefficients[track.at(TRAINING_PART * track.time[-1])][free]
    found = least_squares(
        lambda theta: residuals(theta[:, None])[:, 0], learned, jacobian, x_scale="jac", max_nfev=15
    )
    coefficients = start.values.copy()
    coefficients[free] = found.x
    return coefficients


def row(flight: str) -> str:
    """Return the row of a flight."""
    case = cases.load(flight)
    track = cases.identify(case, {"structure": "flight_dynamics"})
    offline = track.constant(fit(case, track))
    both = [cases.score(case, t).free for t in (track, offline)]
    cells = [f"{triple(online)} | {triple(fitted)}" for online, fitted in zip(*both, strict=True)]
    return f"| {flight} | " + " | ".join(cells) + f" | {(both[0] - both[1]).min():.1f} |"


def main() -> None:
    """Print the table."""
    parser = bench.parser(__doc__, workers=2)
    parser.add_argument("flights", nargs="*", metavar="FLIGHT")
    options = parser.parse_args()
    print("| flight | 1 s, online | offline | 3 s | offline | 5 s | offline | worst |")
    print("|---|---|---|---|---|---|---|---|")
    bench.done(row, options.flights or FLIGHTS, options.workers)


if __name__ == "__main__":
    main()
