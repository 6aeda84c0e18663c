# SPDX-License-Identifier: Apache-2.0
"""Lift and side force: whether they oppose the flow, as they do on every aircraft.

The specific forces fy, fz and the turns of the gyro change the velocity across the body::

    vdot = fy + g_y - r V + ...,   wdot = fz + g_z + q V + ...

The air slows it: fy falls with v, and fz with w. A pitch or yaw rate with the wrong sign turns that
round, in level flight as well. In gusts alone v and w show little where the aircraft drifts with
the air, and the turn of the nose alone misleads if the aircraft is unstable: their sum is taken,
over a second, without mean and slope, which an error of attitude or a gyro bias causes.
"""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.scales import INDEPENDENT_TIME, LONG_MEMORY, TINY
from uav_ident_ros.identification.structure import FloatArray


class LiftSigns:
    """A minute's evidence that fy or fz grows with the velocity along its axis."""

    def __init__(self) -> None:
        # Of fy and fz, sums over the blocks of force times velocity, and of its square
        self._sums: FloatArray = np.zeros((2, 2))

    def add(
        self,
        steps: FloatArray,  # (k,) Durations of the samples, s
        rates: FloatArray,  # (k, 3) rad/s, FRD
        force: FloatArray,  # (k, 3) Specific force, m/s^2, FRD
        gravity: FloatArray,  # (k, 3) m/s^2, FRD
        airspeed: float,  # True, m/s
        *,
        corrected: bool = False,  # Whether the force has a correction for a lever arm
    ) -> None:
        """Add samples that follow each other, in blocks of about `INDEPENDENT_TIME`."""
        across = force[:, 1:]
        turning = airspeed * rates[:, :0:-1] * (-1.0, 1.0)
        velocity_rate = across + gravity[:, 1:] + turning
        change = (velocity_rate + turning) * steps[:, None]
        velocity = np.cumsum(change, axis=0) - 0.5 * change
        between = velocity
        if corrected:
            # Gyro noise is in the velocity and, as its difference, in the force. In the mean of the
            # velocities a step before and a step after it is the same at both ends of the step.
            edges = np.pad(np.cumsum(change, axis=0), ((2, 1), (0, 0)), mode="edge")
            edges[:2] = 0.0
            between = 0.5 * (edges[:-3] + edges[3:])
        parts = max(1, round(float(steps.sum()) / INDEPENDENT_TIME))
        for block in np.array_split(np.arange(len(steps)), parts):
            time = np.cumsum(steps[block])
            line, _ = np.linalg.qr(np.column_stack((np.ones(len(block)), time)))
            # Without mean and slope this leaves the noise of four steps, with the other sign than
            # that of every step in `velocity`.
            share = 2.0 * line.shape[1] / len(block)
            unbiased = between[block] + share * (velocity - between)[block]
            v, f = (a - line @ (line.T @ a) for a in (unbiased, across[block]))
            power = (f * v).sum(axis=0)
            keep = 1.0 - float(time[-1]) / LONG_MEMORY
            fades = np.array([[keep], [keep * keep]])
            self._sums = fades * self._sums + np.stack((power, power**2))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations by which fy and fz support their velocity, (2,); negative if not.

        The sum of independent, symmetric terms over the root of the sum of their squares exceeds x
        with a probability of at most exp(-x^2 / 2) (de la Pena, Lai and Shao, "Self-Normalized
        Processes", 2009).
        """
        total, squares = self._sums
        return np.asarray(total / np.sqrt(squares + TINY))
