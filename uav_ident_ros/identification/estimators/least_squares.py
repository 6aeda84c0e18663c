# SPDX-License-Identifier: Apache-2.0
"""Recursive least squares on the filtered regressors, in information form."""

from __future__ import annotations

from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import FloatArray


class LeastSquaresEstimator:
    """Least squares with forgetting and prior.

    Parameters
    ----------
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    forgetting_time : float
        Time constant of forgetting, s; 0 for never.
    """

    def __init__(self, start: Start, forgetting_time: float) -> None:
        self._information = Information(start, forgetting_time)
        self.coefficients: FloatArray = start.values.copy()
        self.problem = ""

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (3, n)."""
        return self._information.sigma

    def update(self, data: Regression) -> None:
        """Add the samples of a tick and solve."""
        self._information.accumulate(data, data.f, self.coefficients)
        self.coefficients = self._information.solve()
