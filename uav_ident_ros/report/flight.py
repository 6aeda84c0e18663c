# SPDX-License-Identifier: Apache-2.0
"""A flight for the report: measurements, estimates and predictions, in seconds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter

import numpy as np

from uav_ident_ros.identification.prediction import HORIZONS, InputSignal, predict_ahead
from uav_ident_ros.identification.samples import NS, TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.published import STATE_FIELDS
from uav_ident_ros.offline.run import PORTION, OfflineRun


class ReplayedFlight:
    """Measurements and estimates in the order of time; rates in rad/s, body axes FRD."""

    def __init__(
        self,
        run: OfflineRun,  # Finished run with at least one estimate
    ) -> None:
        self.structure = run.structure  # Structure of the estimates
        self.settings = run.inputs.settings
        self.estimates = run.estimates  # One per tick
        self.pieces = run.pieces
        flown = run.flown()
        self._first_ns = int(flown.t_ns[0])
        # Times at which a new time base begins, s
        self.restarts = [(start_ns - self._first_ns) * NS for start_ns in run.restarts]
        self.tick_t = self.seconds(np.array(run.tick_ns))  # Times of the ticks, s, shape (K,)
        # At the N gyro samples: times, s, (N,); p, q, r, rad/s, (N, 3); ay, az, m/s^2, (N, 2);
        # de, dr, da, dth, delayed and lagged, (N, 4)
        self.t, self.rates, self.force = self.seconds(flown.t_ns), flown.rates, flown.force
        self.u = _inputs_at(flown.inputs, flown.t_ns)

    def seconds(self, t_ns: TimeArray) -> FloatArray:
        """Return times by the clock of the flight, ns, as those since its start, s, same shape."""
        return np.asarray((t_ns - self._first_ns) * NS)

    @cached_property
    def ahead(self) -> Predictions:
        """Predictions over the horizon of the score of record."""
        return predict(self, HORIZONS[0])

    @property
    def states(self) -> dict[str, FloatArray]:
        """Published states besides the rates, such as alpha: name to values (K,)."""
        flows = [estimate.flow for estimate in self.estimates if estimate.flow is not None]
        values = np.array([attrgetter(*STATE_FIELDS)(flow) for flow in flows])
        return dict(zip(STATE_FIELDS, values.T, strict=True)) if flows else {}

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of the charts, s."""
        return 0.0, float(max(self.t[-1], self.tick_t[-1]))


def _inputs_at(inputs: InputSignal, t_ns: TimeArray) -> FloatArray:
    if not len(inputs.t_ns):
        return np.zeros((len(t_ns), 4))
    return np.concatenate([inputs.at(t_ns[k : k + PORTION]) for k in range(0, len(t_ns), PORTION)])


@dataclass(frozen=True)
class Predictions:
    """Rates predicted one horizon ahead, and measured ones, p q r in rad/s, FRD."""

    horizon: float  # Time between the start and the end of a prediction, s
    t: FloatArray  # (W,) Times of the ends, s
    # predicted, measured: (W, 3) Prediction and measurement at these times
    predicted: FloatArray
    measured: FloatArray

    @property
    def residual(self) -> FloatArray:
        """Measured minus predicted, shape (W, 3)."""
        return self.measured - self.predicted


def predict(flight: ReplayedFlight, horizon: float) -> Predictions:
    """Return the free predictions from every tick for `horizon` s."""
    parts = [predict_ahead(*piece, horizon) for piece in flight.pieces(horizon)]
    t_ns, predicted = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t_ns, kind="stable")
    t, predicted = flight.seconds(t_ns[order]), predicted[order]
    measured = np.stack([np.interp(t, flight.t, column) for column in flight.rates.T], axis=1)
    return Predictions(horizon, t, predicted, measured)
