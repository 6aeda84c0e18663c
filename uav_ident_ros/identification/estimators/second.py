# SPDX-License-Identifier: Apache-2.0
"""An estimator that learns beside the one in use.

A cold start that comes to nothing has one that begins anew. An aircraft that taxies, or is carried
to its launch, moves its surfaces and does not follow them, and what has learned this holds it
against the flight for minutes. Nobody need have told when it flies: the newest half minute alone
then tells something where all of the time tells nothing.

A start from a file has one that was told nothing: what the flight alone tells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from uav_ident_ros.identification.estimators.model_error import known_without_error
from uav_ident_ros.identification.regression import Layout, Regression, RowSamples
from uav_ident_ros.identification.residuals import NoiseModel
from uav_ident_ros.identification.scales import INDEPENDENT_TIME, SURE
from uav_ident_ros.identification.structure import MAIN_DERIVATIVES, BoolArray, FloatArray

if TYPE_CHECKING:
    from uav_ident_ros.identification.estimators import Estimator

E = TypeVar("E", bound="Estimator")


class SecondEstimator(Generic[E]):
    """An estimator that learns from now on.

    It learns `INDEPENDENT_TIME` at once: an update costs the same for few samples as for many.

    Parameters
    ----------
    estimator : Estimator
        It has learned nothing yet.
    layout : Layout
        Its regression problem.

    Attributes
    ----------
    noise : NoiseModel
        The noise that the samples have shown.
    time : float
        Time of learning, s.
    """

    def __init__(self, estimator: E, layout: Layout) -> None:
        self._layout = layout
        self.estimator, self.noise, self.time = estimator, NoiseModel(layout.rows), 0.0
        self._gathered: list[tuple[Regression, FloatArray]] = []

    def add(self, samples: Regression, weight: FloatArray) -> bool:
        """Take samples, and how much they count in each row, (3,); say whether it has learned."""
        learns = bool(self._gathered) and not self._gathered[-1][0].continued_by(samples)
        if learns:
            self._learn()
        self._gathered.append((samples, samples.time * weight))
        if sum(part.time for part, _ in self._gathered) >= INDEPENDENT_TIME:
            self._learn()
            learns = True
        return learns

    def _learn(self) -> None:
        """Learn from what was gathered."""
        parts, weights = zip(*self._gathered, strict=True)
        self._gathered = []
        samples = Regression.join(parts)
        rows = RowSamples.of(samples, self.estimator.residual(samples), self._layout)
        white = self.noise.whiten(rows, restarted=samples.restarted)
        self.estimator.update(samples, rows, white, np.add.reduce(weights) / samples.time)
        self.time += samples.time


def known_inputs(estimator: Estimator, t_ratio: float = SURE) -> BoolArray:
    """Return which main control derivatives are known to so many sigma, model errors apart, (3,).

    A servo lag that nobody has told is no other aircraft.
    """
    value, sigma = estimator.coefficients[MAIN_DERIVATIVES], estimator.sigma[MAIN_DERIVATIVES]
    known = known_without_error(sigma, value, estimator.model_error, t_ratio)
    return np.asarray((sigma > 0.0) & known)
