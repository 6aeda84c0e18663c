# SPDX-License-Identifier: Apache-2.0
"""Estimators of the coefficients: the paper's law, least squares, the instrumental variable.

All three are the law ``Am_dot = e f^T K``. The paper's K is a setting, that of the others is
computed.
"""

from __future__ import annotations

from typing import Protocol

from uav_ident_ros.identification.estimators.gradient import GradientEstimator
from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.estimators.recursive import RecursiveRegression
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression, RowSamples
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import BoolArray, FloatArray


class Estimator(Protocol):
    """Protocol of an estimator of the coefficients.

    Attributes
    ----------
    coefficients : (R, n) array
        A_m, SI.
    sigma : (R, n) array
        Standard deviations; 0 where a coefficient is not free.
    start : Start
        Initial coefficients, their standard deviations, and flags of the free ones; it may change.
    problem : str
        Failure of the estimator, in a sentence; empty if none.
    learning : (3,) bool array
        Rows that learned at the last update; the others had no excitation.
    changes, rejected : list of (row, column)
        Coefficients whose covariance the last update reset, after a change was detected; those of
        them whose prior it rejected.
    """

    coefficients: FloatArray
    sigma: FloatArray
    start: Start
    problem: str
    learning: BoolArray
    changes: list[tuple[int, int]]
    rejected: list[tuple[int, int]]

    @property
    def clear(self) -> BoolArray:
        """Rows in which the inputs explain more of the motion than disturbances do."""

    @property
    def model_error(self) -> FloatArray:
        """Model error of the main inputs' effects, relative to the effects, (3,)."""

    @property
    def height(self) -> float:
        """Height of the accelerometer above `imu.lever_arm`, m; 0 if not significant."""

    @property
    def answers(self) -> FloatArray:
        """Share of each input that is feedback from disturbances, shape (4,), 0 ... 1."""

    @property
    def may_answer(self) -> BoolArray:
        """Flags of the rows whose main input may be feedback, perhaps by chance, shape (3,)."""

    @property
    def inputs(self) -> FloatArray:
        """Control derivatives at fixed measured forces, as in the residuals, shape (3, 4)."""

    @property
    def information(self) -> Information:
        """Information of the flight; excitation and uncertainty follow from it."""

    def residual(self, samples: Regression) -> FloatArray:
        """Return ``y - A f`` of m samples, shape (m, rows)."""

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Update the estimate with samples.

        Parameters
        ----------
        samples : Regression
            m samples.
        rows : RowSamples
            The same samples, with the regressors of each row, and the residuals of the present
            coefficients.
        white : RowSamples
            The same, whitened.
        weight : (3,) array
            Weight of the samples in each moment row, 0 ... 1.
        """

    def reconfigure(self, settings: Settings) -> None:
        """Apply the settings that may change in flight."""

    def forget(self, weight: float) -> None:
        """Multiply the information so far by `weight`, 0 ... 1."""


def make_estimator(settings: Settings, start: Start) -> Estimator:
    """Return the configured estimator."""
    if settings.estimator == "gradient":
        return GradientEstimator(settings, start)
    instrumental = settings.estimator == "instrumental_variable"
    return RecursiveRegression(start, settings, instrumental=instrumental)
