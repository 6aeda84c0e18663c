# SPDX-License-Identifier: Apache-2.0
"""How far the coefficients can be trusted: one plain verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.running_fit import RunningFit
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    ROWS,
    FloatArray,
    Structure,
)

MIN_PREDICTIONS = 5
"""Predictions before the running fit counts."""

AXES = ("p", "q", "r")


@dataclass(frozen=True)
class Verdict:
    """Whether a controller may act on the coefficients.

    Parameters
    ----------
    usable : bool
        Whether it may.
    reason : str
        Why it may not, in a sentence; empty if it may.
    """

    usable: bool
    reason: str = ""


def judge(
    settings: SupervisionSettings,
    structure: Structure,
    coefficients: FloatArray,
    sigma: FloatArray,
    running: RunningFit,
    age: float,
) -> Verdict:
    """Give the verdict on a set of coefficients.

    Usable are coefficients that predict the next second of every axis clearly better than
    holding the rate does, that know at least one control derivative in every row well, and
    that were confirmed by excited flight not too long ago.

    Parameters
    ----------
    settings : SupervisionSettings
        Thresholds.
    structure : Structure
        Names the coefficients.
    coefficients, sigma : (3, n) arrays
        Estimate and standard deviations.
    running : RunningFit
        Fit of the coefficients.
    age : float
        Time since the rows last learned, s.
    """
    if running.predictions < MIN_PREDICTIONS:
        return Verdict(False, f"only {running.predictions} predictions of 1 s to judge by")
    for axis, fit, hold in zip(AXES, running.fit, running.hold, strict=True):
        if not fit >= max(settings.min_fit, float(hold)):
            return Verdict(
                False,
                f"the 1-second fit of {axis} is {fit:.0f} % (holding the rate: {hold:.0f} %, "
                f"needed: {settings.min_fit:.0f} %)",
            )
    for i, row in enumerate(ROWS):
        ratio, name = _best_known_input(structure, i, coefficients, sigma)
        if ratio < settings.min_t_ratio:
            return Verdict(
                False,
                f"{row} knows no control derivative: the best, {name}, has a t-ratio of "
                f"{ratio:.1f} ({settings.min_t_ratio:.1f} needed); excite it",
            )
    if settings.max_age > 0.0 and age > settings.max_age:
        return Verdict(False, f"nothing was learned for {age:.0f} s")
    return Verdict(True)


def _best_known_input(
    structure: Structure, row: int, coefficients: FloatArray, sigma: FloatArray
) -> tuple[float, str]:
    """Largest t-ratio among a row's control derivatives, and its name."""
    best, name = 0.0, f"{ROWS[row]}/-"
    for j in range(INPUT_COLUMNS.start, INPUT_COLUMNS.stop):
        if not structure.mask[row, j]:
            continue
        value, spread = abs(float(coefficients[row, j])), float(sigma[row, j])
        ratio = value / spread if spread > 0.0 else (np.inf if value > 0.0 else 0.0)
        if ratio >= best:
            best, name = ratio, f"{ROWS[row]}/{structure.regressors[j]}"
    return best, name
