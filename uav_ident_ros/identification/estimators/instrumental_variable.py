# SPDX-License-Identifier: Apache-2.0
"""Recursive instrumental variable with instruments from the identified model's own state.

Gyro noise and gusts are in the regressors and bias least squares. The regressors of the
model's own state are not correlated with them (Young 2011, SRIVC; here in information form
and with guards, since the model is nonlinear and runs while its coefficients are still poor).
"""

from __future__ import annotations

from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import FloatArray

WARM_UP_TIME = 10.0
"""Time for which least squares builds the first model, s."""

TAKE_OVER_WEIGHT = 0.1
"""Weight that the least-squares start keeps when the instruments take over: it is biased,
and at full weight the bias would stay for as long again."""


class InstrumentalVariableEstimator:
    """Guarded instrumental variable with forgetting and prior.

    Parameters
    ----------
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    forgetting_time : float
        Time constant of forgetting, s; 0 for never.
    """

    def __init__(self, start: Start, forgetting_time: float) -> None:
        self._information = Information(start, forgetting_time)
        self._warming_up = True
        self.coefficients: FloatArray = start.values.copy()
        self.problem = ""

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (3, n)."""
        return self._information.sigma

    def update(self, data: Regression) -> None:
        """Add the samples of a tick and solve."""
        if self._warming_up and self._information.time.max() >= WARM_UP_TIME:
            self._warming_up = False
            self._information.discount(TAKE_OVER_WEIGHT)
        z = data.f if self._warming_up else data.z
        self._information.accumulate(data, z, self.coefficients)
        self.coefficients = self._information.solve()
