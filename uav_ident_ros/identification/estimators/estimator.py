# SPDX-License-Identifier: Apache-2.0
"""The base of the estimators, and a second estimator that learns beside the one in use.

After a cold start that identifies nothing, the second one starts afresh. An aircraft that taxies,
or is carried to its launch, moves its surfaces without a response. This information contradicts the
flight for minutes. No takeoff signal is needed: the newest half minute alone then identifies a
derivative where the whole record does not.

After a start from a file, it is the reference: an estimate without the informative prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression, RowSamples
from uav_ident_ros.identification.residuals import Autoregression
from uav_ident_ros.identification.scales import INDEPENDENT_TIME
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import (
    INPUTS,
    ROWS,
    STRUCTURES,
    BoolArray,
    FloatArray,
)


class Estimator:
    """An estimator of the coefficients.

    What a law does not compute stays as it is here.

    Attributes
    ----------
    start : Start
        Initial coefficients, their standard deviations, and flags of the free ones.
    information : Information
        Information of the flight; excitation and uncertainty follow from it.
    noise : Autoregression
        Noise model of the residuals of each row.
    coefficients : (R, n) array
        A_m, SI.
    sigma : (R, n) array
        Standard deviations; 0 where a coefficient is not free.
    linear : (rows, c) array
        Coefficients of the regression problem: those at fixed measured forces.
    problem : str
        Failure of the estimator, in a sentence; empty if none.
    learning : (3,) bool array
        Rows that learned at the last update; the others had no excitation.
    clear : (3,) bool array
        Rows in which the inputs explain more of the motion than disturbances do.
    changes, rejected : list of (row, column)
        Coefficients whose covariance the last update reset, after a change was detected; those of
        them whose prior it rejected.
    model_error : (3,) array
        Model error of the main inputs' effects, relative to the effects.
    sure_error : (3,) array
        The same, where it is significant: sigma contains it.
    delay : float
        Delay plus lag that the inputs have in the samples to come, s; set before an update.
    height : float
        Height of the accelerometer above `imu.lever_arm`, m; 0 if not significant.
    answers : (4,) array
        Share of each input that is feedback from disturbances, 0 ... 1.
    may_answer : (3,) bool array
        Rows whose main input may be feedback, perhaps by chance.
    """

    def __init__(
        self,
        settings: Settings,
        start: Start,
        instrumental: Sequence[bool],  # As in `Information`
        forgetting_time: float = 0.0,
    ) -> None:
        structure, correlation_time = STRUCTURES[settings.structure], 2.0 / settings.filter.cutoff
        self.information = Information(
            structure, start, correlation_time, forgetting_time, instrumental
        )
        self.noise = Autoregression(self.information.layout.rows)
        self.coefficients: FloatArray = start.values.copy()
        self.sigma: FloatArray = start.sigma.copy()
        self.linear: FloatArray = self.coefficients
        self.problem = ""
        self.learning: BoolArray = np.ones(len(ROWS), dtype=bool)
        self.clear: BoolArray = np.ones(len(ROWS), dtype=bool)
        self.changes: list[tuple[int, int]] = []
        self.rejected: list[tuple[int, int]] = []
        self.model_error: FloatArray = np.zeros(len(ROWS))
        self.sure_error: FloatArray = np.zeros(len(ROWS))
        self.delay = math.inf
        self.height = 0.0
        self.answers: FloatArray = np.zeros(len(INPUTS))
        self.may_answer: BoolArray = np.zeros(len(ROWS), dtype=bool)
        self.set_start(start)

    def set_start(self, start: Start) -> None:
        """Replace initial coefficients and prior; what was learned stays."""
        self.start = start

    def conditioned(self, samples: Regression) -> tuple[RowSamples, RowSamples]:
        """Return samples row by row, with the residuals of the present estimate, and whitened."""
        rows = RowSamples.of(samples, samples.residual(self.linear), self.information.layout)
        white = self.noise.whiten(rows.signals, rows.dt, restarted=samples.restarted)
        return rows, RowSamples(white, rows.dt)

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Update the estimate with samples.

        Parameters
        ----------
        samples : Regression
            m samples.
        rows, white : RowSamples
            The same, as `conditioned` returns them.
        weight : (3,) array
            Weight of the samples in each moment row, 0 ... 1.
        """
        raise NotImplementedError

    def reconfigure(self, settings: Settings) -> None:
        """Apply the settings that may change in flight."""

    def forget(self, weight: float) -> None:
        """Multiply the information so far by `weight`, 0 ... 1."""
        self.information.discount(weight)


E = TypeVar("E", bound=Estimator)


class SecondEstimator(Generic[E]):
    """An estimator that learns from its construction on.

    It learns `INDEPENDENT_TIME` at a time: the cost of an update does not depend on its samples.

    Parameters
    ----------
    estimator : Estimator
        A new one, without information.

    Attributes
    ----------
    time : float
        Time of learning, s.
    """

    def __init__(self, estimator: E) -> None:
        self.estimator, self.time = estimator, 0.0
        self._gathered: list[tuple[Regression, FloatArray]] = []

    def add(self, samples: Regression, weight: FloatArray) -> bool:
        """Add samples with their weights in the rows, (3,); return whether the estimate is new."""
        learns = bool(self._gathered) and not self._gathered[-1][0].continued_by(samples)
        if learns:
            self._learn()
        self._gathered.append((samples, samples.time * weight))
        time = sum(part.time for part, _ in self._gathered)
        if time >= INDEPENDENT_TIME - 0.5 * samples.dt:  # whatever the rounding of the sum
            self._learn()
            learns = True
        return learns

    def _learn(self) -> None:
        """Update the estimator with the collected samples."""
        parts, weights = zip(*self._gathered, strict=True)
        self._gathered = []
        samples = Regression.join(parts)
        rows, white = self.estimator.conditioned(samples)
        self.estimator.update(samples, rows, white, np.add.reduce(weights) / samples.time)
        self.time += samples.time
