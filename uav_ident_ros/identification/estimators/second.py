# SPDX-License-Identifier: Apache-2.0
"""A second estimator that learns in parallel with the one in use.

After a cold start that identifies nothing, it starts afresh. An aircraft that taxies, or is carried
to its launch, moves its surfaces without a response. This information contradicts the flight for
minutes. No takeoff signal is needed: the newest half minute alone then identifies a derivative
where the whole record does not.

After a start from a file, it is the reference: an estimate without the informative prior.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from uav_ident_ros.identification.estimators.model_error import known_without_error
from uav_ident_ros.identification.regression import Layout, Regression, RowSamples
from uav_ident_ros.identification.residuals import Autoregression
from uav_ident_ros.identification.scales import INDEPENDENT_TIME, SURE
from uav_ident_ros.identification.structure import MAIN_DERIVATIVES, BoolArray, FloatArray

if TYPE_CHECKING:
    from uav_ident_ros.identification.estimators import Estimator

E = TypeVar("E", bound="Estimator")


class SecondEstimator(Generic[E]):
    """An estimator that learns from its construction on.

    It learns `INDEPENDENT_TIME` at a time: the cost of an update does not depend on its samples.

    Parameters
    ----------
    estimator : Estimator
        A new one, without information.
    layout : Layout
        Its regression problem.

    Attributes
    ----------
    noise : Autoregression
        Noise model of the samples.
    time : float
        Time of learning, s.
    """

    def __init__(self, estimator: E, layout: Layout) -> None:
        self._layout = layout
        self.estimator, self.noise, self.time = estimator, Autoregression(layout.rows), 0.0
        self._gathered: list[tuple[Regression, FloatArray]] = []

    def add(self, samples: Regression, weight: FloatArray) -> bool:
        """Add samples with their weights in the rows, (3,); return whether the estimate is new."""
        learns = bool(self._gathered) and not self._gathered[-1][0].continued_by(samples)
        if learns:
            self._learn()
        self._gathered.append((samples, samples.time * weight))
        if sum(part.time for part, _ in self._gathered) >= INDEPENDENT_TIME:
            self._learn()
            learns = True
        return learns

    def _learn(self) -> None:
        """Update the estimator with the collected samples."""
        parts, weights = zip(*self._gathered, strict=True)
        self._gathered = []
        samples = Regression.join(parts)
        rows = RowSamples.of(samples, self.estimator.residual(samples), self._layout)
        white = self.noise.whiten(rows, restarted=samples.restarted)
        self.estimator.update(samples, rows, white, np.add.reduce(weights) / samples.time)
        self.time += samples.time


def known_inputs(estimator: Estimator, t_ratio: float = SURE) -> BoolArray:
    """Return which main control derivatives exceed this t-ratio, model errors excluded, (3,).

    A servo lag that is not configured is a model error and no reason to start afresh.
    """
    value, sigma = estimator.coefficients[MAIN_DERIVATIVES], estimator.sigma[MAIN_DERIVATIVES]
    known = known_without_error(sigma, value, estimator.model_error, t_ratio)
    return np.asarray((sigma > 0.0) & known)
