# SPDX-License-Identifier: Apache-2.0
"""What the model of each tick said about the rates a while later, beside what came."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.prediction import LAST_PART, Published, predict_ahead
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.report.flight import Flight

SHORTEST_FIT = 2
"""Predictions from which a spread, and so a fit, is defined."""


@dataclass(frozen=True)
class Predictions:
    """Rates predicted one horizon ahead, and measured, p q r in rad/s, FRD."""

    horizon: float  # How far ahead, s
    t: FloatArray  # (W,) Times that the predictions are for, s
    # predicted, measured: (W, 3) Prediction and measurement at these times
    predicted: FloatArray
    measured: FloatArray
    # (W, 3) Measured when the prediction was made: what holding the rates predicts
    before: FloatArray

    @property
    def residual(self) -> FloatArray:
        """Measured minus predicted, shape (W, 3)."""
        return self.measured - self.predicted

    def fit(self, end: float) -> tuple[FloatArray, FloatArray]:
        """Fit of the model and of holding the rates, percent, (3,) each.

        The formula of the score of record, over the points that were predicted in the last 40 %
        of a flight that ends at `end` s. NaN if there are none.
        """
        chosen = self.t - self.horizon >= (1.0 - LAST_PART) * end
        if np.count_nonzero(chosen) < SHORTEST_FIT:
            return np.full(3, np.nan), np.full(3, np.nan)
        measured = self.measured[chosen]
        spread = np.linalg.norm(measured - measured.mean(axis=0), axis=0)
        spread[spread == 0.0] = np.nan
        model, hold = (
            100.0 * (1.0 - np.linalg.norm(measured - other[chosen], axis=0) / spread)
            for other in (self.predicted, self.before)
        )
        return model, hold


def predict(
    flight: Flight,  # The flight
    horizon: float,  # How far ahead, s
) -> Predictions:
    """Run the model of every tick for `horizon` s."""
    parts = []
    for part in flight.stretches:
        for piece in part.pieces(horizon):
            published = Published.of(piece.ticks, flight.structure)
            t_ns, predicted = predict_ahead(piece, published, horizon)
            t = flight.clock.seconds(part.era, t_ns)
            parts.append((t, predicted, *(flight.rates_at(s) for s in (t, t - horizon))))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    return Predictions(horizon, *(column[order] for column in columns))
