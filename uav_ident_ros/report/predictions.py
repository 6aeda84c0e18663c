# SPDX-License-Identifier: Apache-2.0
"""What the model of each tick said about the rates a while later, beside what came."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.prediction import LAST_PART, Flown, Published, predict_ahead
from uav_ident_ros.identification.samples import NS, TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.offline.run import Stretch
from uav_ident_ros.offline.ticks import Ticks
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
    horizon_ns = round(horizon / NS)
    parts = [
        _of_piece(flight, part, piece, horizon_ns)
        for part in flight.stretches
        for piece in part.pieces(horizon)
    ]
    t, predicted, measured, before = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t, kind="stable")
    return Predictions(horizon, t[order], predicted[order], measured[order], before[order])


def _of_piece(
    flight: Flight, part: Stretch, piece: tuple[Flown, Ticks], horizon_ns: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return time, prediction, measurement, and measurement one horizon before."""
    flown, ticks = piece
    published = Published.of(ticks, flight.structure)
    t_ns, predicted = predict_ahead(flown, published, horizon_ns * NS)
    t = flight.clock.seconds(part.era, t_ns)
    return t, predicted, _rates_at(part, t_ns), _rates_at(part, t_ns - horizon_ns)


def _rates_at(part: Stretch, t_ns: TimeArray) -> FloatArray:
    """Measured rates by straight lines, shape (len(t_ns), 3)."""
    origin = int(part.t_ns[0])
    columns = [np.interp(t_ns - origin, part.t_ns - origin, column) for column in part.rates.T]
    return np.stack(columns, axis=1)
