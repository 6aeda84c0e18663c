# SPDX-License-Identifier: Apache-2.0
"""Control allocation: bounded weighted least squares, solved exactly by an active set."""

import numpy as np

from uav_ident_ros.identification.structure import MAIN_PLACES, ROWS, FloatArray

REST = 1e-3
"""Weight of small inputs relative to the acceleration error, both as shares of full travel. It
decides only between inputs of equal effect."""

MAIN_EFFECTS = np.arange(len(ROWS)), MAIN_PLACES
"""Index of the main control derivatives in B: each axis, and its own input."""


def allocate(
    effect: FloatArray,  # (3, 4) Control derivatives, rad/s^2 per unit of each input
    wanted: FloatArray,  # (3,) Angular acceleration that the inputs must produce, rad/s^2
    # (2, 4) Lower and upper limit of each input, 0 between; equal for an input that is not used
    limits: FloatArray,
    scale: FloatArray,  # (3,) Unit of the acceleration of each axis, rad/s^2; see `authority`
) -> FloatArray:
    """Return the inputs within their limits that come closest to the wanted acceleration.

    They minimise the sum of squares of ``w (effect u - wanted) / scale``. The inputs, as shares of
    their travel, enter with a small weight, so that the solution is unique: an input without effect
    stays at zero. The wanted acceleration of an axis is clipped to what its own input can produce.
    The weight w of an axis is that range over its nominal one, `scale`. An axis with a lost or
    saturated surface therefore does not use the surface of another axis.

    Raises
    ------
    ValueError
        If effect or acceleration are not finite.
    """
    if not (np.isfinite(effect).all() and np.isfinite(wanted).all()):
        raise ValueError("the control derivatives or the wanted acceleration are not finite")
    low, high = limits
    travel = np.where(high > low, high - low, 1.0)
    own = effect[MAIN_EFFECTS]
    least, most = np.sort(own * limits[:, MAIN_PLACES], axis=0)
    weight = np.minimum(1.0, 0.5 * (most - least) / scale) / scale
    # the unknowns are shares of travel, s: u = travel * s
    rows = np.vstack([weight[:, None] * effect * travel, REST * np.eye(len(low))])

    def solved(demand: FloatArray) -> FloatArray:
        target = np.append(weight * demand, np.zeros(len(low)))
        share = bounded_least_squares(rows, target, low / travel, high / travel)
        return np.clip(travel * share, low, high)

    demand = np.clip(wanted, least, most)
    u = solved(demand)
    by_others = effect @ u - own * u[MAIN_PLACES]  # cross-axis effect of the other axes' inputs
    whole = np.clip(wanted, least + by_others, most + by_others)
    return u if np.array_equal(whole, demand) else solved(whole)


def authority(effect: FloatArray, limits: FloatArray) -> FloatArray:
    """Return the angular acceleration of each axis for half of all travel, shape (3,), rad/s^2."""
    return np.asarray(0.5 * np.abs(effect) @ (limits[1] - limits[0]))


def bounded_least_squares(
    rows: FloatArray, target: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return the x within low and high that minimises ``|rows x - target|``; 0 must be within.

    The primal active-set method solves for the free unknowns and stops at the first bound that is
    reached, which becomes active. If none is reached, it releases the active bound with the largest
    inward gradient, or ends. With independent columns each step reduces the sum, so that it ends.
    """
    x = np.zeros(len(low))
    held = np.zeros(len(low))  # -1 at low, +1 at high, 0 free
    normal = rows.T @ rows
    while True:
        free = held == 0.0
        step = np.zeros(len(low))
        if free.any():
            pull = rows[:, free].T @ (target - rows @ x)
            step[free] = np.linalg.solve(normal[np.ix_(free, free)], pull)
        room = np.where(step > 0.0, high - x, low - x)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(step != 0.0, room / step, np.inf)
        first = int(np.argmin(share))
        if share[first] < 1.0:
            x = x + max(share[first], 0.0) * step
            held[first] = np.sign(step[first])
            x[first] = high[first] if held[first] > 0.0 else low[first]
            continue
        x = x + step
        outward = held * (rows.T @ (target - rows @ x))
        worst = int(np.argmin(outward))
        if outward[worst] >= -1e-12:
            return x
        held[worst] = 0.0
