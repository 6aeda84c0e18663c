# SPDX-License-Identifier: Apache-2.0
"""A flight that was replayed, and what there is to say about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from uav_ident_ros.identification.prediction import PredictionFit
from uav_ident_ros.offline.advice import Advice
from uav_ident_ros.offline.run import OfflineRun


@dataclass(frozen=True)
class Replayed:
    """Everything that the results of a replay are made of.

    Parameters
    ----------
    name : str
        Name of the flight.
    run : OfflineRun
        The replay, with at least one estimate.
    fits : mapping
        Its score of record, by windows.
    notes : tuple of str
        What the bag is like: damage, topics that were not read, inputs that end early.
    advice : tuple of Advice
        What to do about the model.
    """

    name: str
    run: OfflineRun
    fits: Mapping[str, PredictionFit]
    notes: tuple[str, ...] = ()
    advice: tuple[Advice, ...] = ()
