# SPDX-License-Identifier: Apache-2.0
"""A flight that was replayed, and what there is to say about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.linearisation import Condition, Mode, modes
from uav_ident_ros.identification.prediction import PredictionFit
from uav_ident_ros.offline.advice import Advice
from uav_ident_ros.offline.run import OfflineRun

VERDICT_WINDOWS = "last_40_percent"
"""The windows of the score that the verdict must not contradict."""


@dataclass(frozen=True)
class Replayed:
    """Everything that the results of a replay are made of."""

    name: str  # Name of the flight
    run: OfflineRun  # The replay, with at least one estimate
    fits: Mapping[str, PredictionFit]  # Its score of record, by windows
    # What the bag is like: damage, topics that were not read, inputs that end early
    notes: tuple[str, ...] = ()
    advice: tuple[Advice, ...] = ()  # What to do about the model

    @property
    def doubt(self) -> str:
        """Why a controller should not act on the model; empty if it may.

        The verdict of the last tick, unless the score beside it loses to holding the rates.
        """
        last = self.run.estimates[-1]
        if not last.usable:
            return last.reason or "the verdict of the last tick"
        score = self.fits[VERDICT_WINDOWS]
        worse = [
            axis
            for axis, model, hold in zip("pqr", score.model, score.hold, strict=True)
            if model < hold
        ]
        if worse:
            return f"over the last part of the flight {', '.join(worse)} loses to holding the rate"
        return ""

    def modes(self) -> list[Mode]:
        """Return the modes of the model, level at the airspeed flown; none without flow angles."""
        last = self.run.estimates[-1]
        if last.flow is None or not last.flow.airspeed > 0.0:
            return []
        condition = Condition(last.flow.airspeed)
        try:
            return modes(self.run.structure, last.coefficients, last.sigma, condition)
        except np.linalg.LinAlgError:
            return []  # a model of so short a flight that it is none
