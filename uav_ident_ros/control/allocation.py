# SPDX-License-Identifier: Apache-2.0
"""Control allocation: bounded weighted least squares, solved exactly by an active set."""

import numpy as np

from uav_ident_ros.identification.structure import FloatArray

PREFERENCE = 1e-3
"""Weight of staying at the preferred inputs against reaching the wanted acceleration, both in
shares of what full travel gives: it decides only between inputs that do the same."""


UNMET, GIVES_WAY = 0.05, 0.03
"""Share of its worth by which an axis may fall short before it gives way to the others, and the
weight that it keeps then: its square is a thousandth."""


def allocate(
    effect: FloatArray,
    wanted: FloatArray,
    limits: FloatArray,
    scale: FloatArray,
    preferred: FloatArray | None = None,
) -> FloatArray:
    """Return the inputs within their limits that come closest to the wanted acceleration.

    Minimal is the sum of squares of ``(effect u - wanted) / scale``, and of the distance from the
    preferred inputs in shares of their travel, with a small weight. So there is always one
    answer: an input without any effect stays where it is preferred, and one at its limit leaves
    the rest to the others. An axis is worth what it could do in full health, its `scale`. So an
    axis that has lost its surface cannot draw on another's: what little the rudder rolls is not
    worth the yaw that it costs. What cannot be had all the same gives way to what can.

    Parameters
    ----------
    effect : (3, m) array
        Control derivatives, rad/s^2 per unit of each input.
    wanted : (3,) array
        Angular acceleration that the inputs are to make, rad/s^2.
    limits : (2, m) array
        Least and largest of each input; equal for one that is not to be used.
    scale : (3,) array
        Acceleration that counts as one for each axis, rad/s^2; see `authority`.
    preferred : (m,) array, optional
        Inputs to stay near; zero by default, within the limits.
    """
    low, high = limits
    travel = np.where(high > low, high - low, 1.0)
    near = np.clip(np.zeros(len(low)) if preferred is None else preferred, low, high)
    # in shares of travel from the preferred inputs: u = near + travel * s
    rows = np.vstack([effect * travel / scale[:, None], PREFERENCE * np.eye(len(low))])
    target = np.append((wanted - effect @ near) / scale, np.zeros(len(low)))
    bounds = (low - near) / travel, (high - near) / travel
    share = bounded_least_squares(rows, target, *bounds)
    short = np.abs(target - rows @ share)[: len(scale)]
    unmet = short > max(UNMET, 0.5 * short.max())  # not the axes that it drew on
    if unmet.any() and not unmet.all():
        weight = np.append(np.where(unmet, GIVES_WAY, 1.0), np.ones(len(low)))
        share = bounded_least_squares(weight[:, None] * rows, weight * target, *bounds)
    return np.clip(near + travel * share, low, high)


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
