# SPDX-License-Identifier: Apache-2.0
"""How the coefficients move: the paper's law, least squares, the instrumental variable.

All three are the law ``Am_dot = e f^T K``: the first with a K that is chosen, the others with
one that is computed.
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
    """What moves the coefficients.

    Attributes
    ----------
    coefficients : (R, n) array
        A_m, SI.
    sigma : (R, n) array
        Standard deviations; 0 where a coefficient is not free.
    start : Start
        Initial coefficients, their uncertainty, and which are free; it may change.
    problem : str
        What went wrong, in a sentence; empty if nothing did.
    learning : (3,) bool array
        Rows that learned at the last update; the others saw no excitation.
    changes, rejected : list of (row, column)
        Coefficients that were found changed, and released, at the last update; those of them that
        were told wrong.
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
        """Rows in which the inputs stand out from all else that moves the aircraft."""

    @property
    def model_error(self) -> FloatArray:
        """What the main inputs do otherwise than the model says, relative to their effect, (3,)."""

    @property
    def height(self) -> float:
        """Height of the accelerometer above where it is said to be, m; 0 if no more than chance."""

    @property
    def answers(self) -> FloatArray:
        """Share of each input that answers disturbances, shape (4,), 0 ... 1."""

    @property
    def inputs(self) -> FloatArray:
        """Control derivatives that go with the residuals, shape (3, 4): with measured forces."""

    @property
    def information(self) -> Information:
        """What the flight has told, by which excitation and uncertainty are judged."""

    def residual(self, samples: Regression) -> FloatArray:
        """Return ``y - A f`` of m samples, shape (m, rows)."""

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Learn from samples.

        Parameters
        ----------
        samples : Regression
            m samples.
        rows : RowSamples
            The same samples, with what each row is regressed on, and their residuals from the
            coefficients as they are.
        white : RowSamples
            Those, whitened.
        weight : (3,) array
            How much they count in each moment row, 0 ... 1.
        """

    def reconfigure(self, settings: Settings) -> None:
        """Take over the settings that may change in flight."""

    def forget(self, weight: float) -> None:
        """Let all that was learned so far count for `weight` of what it did, 0 ... 1."""


def make_estimator(settings: Settings, start: Start) -> Estimator:
    """Return the estimator that the settings name."""
    if settings.estimator == "gradient":
        return GradientEstimator(settings, start)
    instrumental = settings.estimator == "instrumental_variable"
    return RecursiveRegression(start, settings, instrumental=instrumental)
