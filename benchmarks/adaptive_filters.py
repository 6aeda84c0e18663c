# SPDX-License-Identifier: Apache-2.0
"""The adaptive filters of `padasip`, fed with the identifier's own filtered regressors."""

import bench  # noqa: F401  (before NumPy)
import numpy as np
import padasip
from numpy.typing import NDArray

from uav_ident_ros.identification.regression import Regression, RowSamples
from uav_ident_ros.identification.structure import INPUT_COLUMNS, FloatArray

RLS_FORGETTING = 0.998
"""Per update; at 20 Hz a time constant of 25 s, the usual choice."""

NLMS_STEPS = (0.01, 0.05, 0.2, 0.5)
"""Step sizes tried: the best in hindsight is what is compared."""

FILTERS = {"RLS": padasip.filters.FilterRLS, "NLMS": padasip.filters.FilterNLMS}


class RegressionRecorder:
    """Stands in an estimator's place and keeps the samples."""

    def __init__(
        self,
        shape: tuple[int, ...],  # Shape (3, n) of the coefficients
    ) -> None:
        self.coefficients: FloatArray = np.zeros(shape)
        self.sigma: FloatArray = np.zeros(shape)
        self.problem = ""
        self.learning = np.ones(3, dtype=bool)
        self.clear = np.ones(3, dtype=bool)
        self.model_error = np.zeros(3)
        self.height = 0.0
        self.answers = np.zeros(4)
        self.changes: list[tuple[int, int]] = []
        self.y: list[FloatArray] = []  # (3,) Accelerations; one entry per sample
        self.f: list[FloatArray] = []  # (n,) Regressors

    @property
    def inputs(self) -> FloatArray:
        """Control derivatives: none are known."""
        return self.coefficients[:, INPUT_COLUMNS]

    def residual(self, samples: Regression) -> FloatArray:
        """Return what no coefficients leave of samples: all of it."""
        return samples.residual(self.coefficients)

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Keep the samples."""
        self.y.extend(samples.y)
        self.f.extend(samples.f)


def run_filter(
    kind: str,  # ``RLS`` or ``NLMS``
    mu: float,  # Forgetting factor of RLS, step of NLMS
    recorder: RegressionRecorder,  # The data
    free: NDArray[np.bool_],  # (3, n) Coefficients of the structure
) -> FloatArray:
    """Coefficients after each update, shape (updates, 3, n)."""
    out = np.zeros((len(recorder.y), *free.shape))
    for i, row in enumerate(free):
        one = FILTERS[kind](int(row.sum()), mu=mu, w="zeros")
        for k, (y, f) in enumerate(zip(recorder.y, recorder.f, strict=True)):
            one.adapt(y[i], f[row])
            out[k, i, row] = one.w
    return out
