# SPDX-License-Identifier: Apache-2.0
"""Control allocation: bounded weighted least squares, solved exactly by an active set."""

import numpy as np

from uav_ident_ros.identification.structure import INPUT_COLUMNS, MAIN_DERIVATIVES, FloatArray

REST = 1e-3
"""Weight of rest against reaching the wanted acceleration, both in shares of what full travel
gives: it decides only between inputs that do the same."""

AXES, MAINS = MAIN_DERIVATIVES[0], MAIN_DERIVATIVES[1] - INPUT_COLUMNS.start
"""The axes, and the input that each has for itself: places of the main derivatives in B."""


def allocate(
    effect: FloatArray,  # (3, 4) Control derivatives, rad/s^2 per unit of each input
    wanted: FloatArray,  # (3,) Angular acceleration that the inputs are to make, rad/s^2
    # (2, 4) Least and largest of each input, 0 within; equal for one that is not to be used
    limits: FloatArray,
    scale: FloatArray,  # (3,) What counts as one for each axis, rad/s^2; see `authority`
) -> FloatArray:
    """Return the inputs within their limits that come closest to the wanted acceleration.

    Minimal is the sum of squares of ``w (effect u - wanted) / scale``, and of the inputs in shares
    of their travel, with a small weight. So there is always one answer: an input without any
    effect rests, and one at its limit leaves the rest to the others. An axis asks for no more than
    its own input gives, and weighs w, what that is of what it could do in full health, its
    `scale`. So an axis that has lost its surface, or is at its limit, cannot draw on another's.

    Raises
    ------
    ValueError
        If effect or acceleration are not finite: no inputs come closest.
    """
    if not (np.isfinite(effect).all() and np.isfinite(wanted).all()):
        raise ValueError("the control derivatives or the wanted acceleration are not finite")
    low, high = limits
    travel = np.where(high > low, high - low, 1.0)
    own = effect[AXES, MAINS]
    least, most = np.sort(own * limits[:, MAINS], axis=0)
    weight = np.minimum(1.0, 0.5 * (most - least) / scale) / scale
    # in shares of travel: u = travel * s
    rows = np.vstack([weight[:, None] * effect * travel, REST * np.eye(len(low))])

    def solved(asked: FloatArray) -> FloatArray:
        target = np.append(weight * asked, np.zeros(len(low)))
        share = bounded_least_squares(rows, target, low / travel, high / travel)
        return np.clip(travel * share, low, high)

    u = solved(np.clip(wanted, least, most))
    by_others = effect @ u - own * u[MAINS]  # as they serve their own axes
    return solved(np.clip(wanted, least + by_others, most + by_others))


def authority(effect: FloatArray, limits: FloatArray) -> FloatArray:
    """Return what each axis can do with half of all travel, shape (3,), rad/s^2."""
    return np.asarray(0.5 * np.abs(effect) @ (limits[1] - limits[0]))


def bounded_least_squares(
    rows: FloatArray, target: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return the x within low and high that minimises ``|rows x - target|``; 0 must be within.

    The primal active-set method: solve for the free unknowns; stop at the first bound in the way
    and hold it; where none is, let go of the held one that pulls inwards most, or be done. With
    independent columns each step lessens the sum and no set comes twice, so that it ends.
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
