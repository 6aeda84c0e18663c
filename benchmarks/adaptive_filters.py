# SPDX-License-Identifier: Apache-2.0
"""The adaptive filters of `padasip` on the identifier's filtered regressors."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from cases import Case, Track, identify

from uav_ident_ros.identification.estimators.recursive import RecursiveRegression
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression, RowSamples
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray

RLS_FORGETTING = 0.998
"""Forgetting factor per update, a common choice: at 20 Hz a time constant of 25 s."""

NLMS_STEPS = (0.01, 0.05, 0.2, 0.5)
"""Step sizes; the best of them in hindsight is compared."""


def make_filter(
    kind: str,  # ``RLS`` or ``NLMS``
    count: int,  # Coefficients
    mu: float,  # Forgetting factor of RLS, step of NLMS
) -> Any:
    """Return a filter of `padasip`, whose import takes a second."""
    import padasip

    return getattr(padasip.filters, f"Filter{kind}")(count, mu=mu, w="zeros")


class RegressionRecorder(RecursiveRegression):
    """Estimator that records the samples and learns nothing."""

    def __init__(self, settings: Settings, start: Start) -> None:
        super().__init__(start, settings, instrumental=True)
        self.y: list[FloatArray] = []  # (3,) Accelerations; one entry per sample
        self.f: list[FloatArray] = []  # (n,) Regressors

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Record the samples."""
        self.y.extend(samples.y)
        self.f.extend(samples.f)


def recorded(case: Case, values: Mapping[str, object]) -> tuple[Track, RegressionRecorder]:
    """Run the identifier over a flight; return its ticks and the recorded samples."""
    one: list[RegressionRecorder] = []

    def make(settings: Settings, start: Start) -> RegressionRecorder:
        one[:] = one or [RegressionRecorder(settings, start)]
        return one[0]

    return identify(case, values, make), one[0]


def run_filter(
    kind: str,  # ``RLS`` or ``NLMS``
    mu: float,  # Forgetting factor of RLS, step of NLMS
    recorder: RegressionRecorder,  # The data
) -> FloatArray:
    """Return the coefficients after each update, shape (updates, 3, n)."""
    free = recorder.start.free
    out = np.zeros((len(recorder.y), *free.shape))
    for i, row in enumerate(free):
        one = make_filter(kind, int(row.sum()), mu)
        for k, (y, f) in enumerate(zip(recorder.y, recorder.f, strict=True)):
            one.adapt(y[i], f[row])
            out[k, i, row] = one.w
    return out
