# SPDX-License-Identifier: Apache-2.0
"""A start that begins anew beside one that comes to nothing.

An aircraft that taxies, or is carried to its launch, moves its surfaces and does not follow them. A
cold start that has learned this holds it against the flight for minutes. Nobody need have told when
it flies: the newest half minute alone then tells something where all of the time tells nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uav_ident_ros.identification.estimators import Estimator
from uav_ident_ros.identification.estimators.model_error import known_beside
from uav_ident_ros.identification.regression import Layout, Regression, RowSamples
from uav_ident_ros.identification.residuals import NoiseModel
from uav_ident_ros.identification.scales import INDEPENDENT_TIME, SURE
from uav_ident_ros.identification.structure import MAIN_DERIVATIVES, ROWS, BoolArray


class FreshStart:
    """An estimator that learns from now on, beside the one in use.

    It learns `INDEPENDENT_TIME` at once: an update costs the same for few samples as for many.

    Parameters
    ----------
    make : callable
        Makes an estimator that knows no more than a cold start does.
    layout : Layout
        Its regression problem.

    Attributes
    ----------
    estimator : Estimator
        What the samples since then have told.
    noise : NoiseModel
        The noise that they have shown.
    time : float
        Time of learning, s.
    """

    def __init__(self, make: Callable[[], Estimator], layout: Layout) -> None:
        self._layout = layout
        self.estimator, self.noise, self.time = make(), NoiseModel(layout.rows), 0.0
        self._gathered: list[Regression] = []

    def add(self, samples: Regression) -> None:
        """Take samples."""
        if self._gathered and not self._gathered[-1].continued_by(samples):
            self._learn()
        self._gathered.append(samples)
        if sum(part.time for part in self._gathered) >= INDEPENDENT_TIME:
            self._learn()

    def _learn(self) -> None:
        """Learn from what was gathered."""
        samples = Regression.join(self._gathered)
        self._gathered = []
        rows = RowSamples.of(samples, self.estimator.residual(samples), self._layout)
        white = self.noise.whiten(rows, restarted=samples.restarted)
        self.estimator.update(samples, rows, white, np.ones(len(ROWS)))
        self.time += samples.time


def known_inputs(estimator: Estimator, t_ratio: float = SURE) -> BoolArray:
    """Return which main control derivatives are known to so many sigma, model errors apart, (3,).

    A servo lag that nobody has told is no other aircraft.
    """
    value, sigma = estimator.coefficients[MAIN_DERIVATIVES], estimator.sigma[MAIN_DERIVATIVES]
    known = known_beside(sigma, value, estimator.model_error, t_ratio)
    return np.asarray((sigma > 0.0) & known)
