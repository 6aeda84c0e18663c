# SPDX-License-Identifier: Apache-2.0
"""How the coefficients move: the paper's law, least squares, the instrumental variable.

All three are the law ``Am_dot = e f^T K``: the first with a K that is chosen, the others with
one that is computed.
"""

from __future__ import annotations

from typing import Protocol

from uav_ident_ros.identification.estimators.gradient import GradientEstimator
from uav_ident_ros.identification.estimators.instrumental_variable import (
    InstrumentalVariableEstimator,
)
from uav_ident_ros.identification.estimators.least_squares import LeastSquaresEstimator
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray


class Estimator(Protocol):
    """What moves the coefficients.

    Attributes
    ----------
    coefficients : (3, n) array
        A_m, SI.
    problem : str
        What went wrong, in a sentence; empty if nothing did.
    """

    coefficients: FloatArray
    problem: str

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (3, n); 0 where a coefficient is not free."""

    def update(self, data: Regression) -> None:
        """Learn from the samples of a tick."""


def make_estimator(settings: Settings, start: Start) -> Estimator:
    """Return the estimator that the settings name."""
    if settings.estimator == "gradient":
        return GradientEstimator(settings.gradient, start)
    if settings.estimator == "instrumental_variable":
        return InstrumentalVariableEstimator(start, settings.forgetting_time)
    return LeastSquaresEstimator(start, settings.forgetting_time)
