# SPDX-License-Identifier: Apache-2.0
"""How far the coefficients can be trusted: the running fit, and one plain verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.model import LARGEST_RATE, IdentifiedModel
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.settings import SupervisionSettings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    ROWS,
    FloatArray,
    Structure,
)

PREDICTION_TIME = 1.0
"""Length of a prediction, s, as in the score of record."""

FIT_MEMORY = 30.0
"""Time constant of the running fit, s."""

MIN_PREDICTIONS = 5
"""Predictions before the running fit counts."""

AXES = ("p", "q", "r")


class RunningFit:
    """1-second prediction fit of the coefficients in use, beside that of holding the rates.

    Predictions follow one another: each starts from the measured rates, with the coefficients
    of that time, and is compared with every sample of its second.

    Attributes
    ----------
    fit, hold : (3,) array
        Fit of p, q, r in percent, of the model and of the rate held; 0 until there is one.
    predictions : int
        Predictions that have counted.
    """

    def __init__(self, model: IdentifiedModel) -> None:
        self._model = model
        self.fit: FloatArray = np.zeros(3)
        self.hold: FloatArray = np.zeros(3)
        self.predictions = 0
        self._coefficients: FloatArray | None = None
        self._state: FloatArray = np.zeros(3)
        self._held: FloatArray = np.zeros(3)
        self._time = 0.0
        # Weighted sums over samples: count, x, x^2, squared errors of model and of holding.
        self._now: FloatArray = np.zeros((5, 3))
        self._past: FloatArray = np.zeros((5, 3))

    def restart(self) -> None:
        """Give up the prediction under way."""
        self._coefficients = None

    def add(self, block: Block, coefficients: FloatArray) -> None:
        """Compare the prediction under way with a block of signals, shapes as in `Block`."""
        if block.restarted:
            self.restart()
        if self._coefficients is None:
            self._coefficients = coefficients
            self._state = self._held = block.x[0]
            self._time = 0.0
            self._now = np.zeros((5, 3))
        predicted = self._model.propagate(self._coefficients, block, self._state)
        # A divergent prediction is clipped, as in the score of record; NaN fails the test too.
        predicted = np.where(np.abs(predicted) < LARGEST_RATE, predicted, LARGEST_RATE)
        self._state = predicted[-1]
        x = block.x[1:]
        self._now[0] += len(x)
        for k, part in enumerate((x, x * x, (x - predicted[1:]) ** 2, (x - self._held) ** 2)):
            self._now[1 + k] += np.add.reduce(part)
        self._time += block.h * len(x)
        if self._time >= PREDICTION_TIME:
            self._close()

    def _close(self) -> None:
        keep = np.exp(-self._time / FIT_MEMORY)
        self._past = keep * self._past + self._now
        self.predictions += 1
        self._coefficients = None
        count, total, square, error, held = self._past
        spread = square - total * total / count
        moving = spread > 0.0
        for fit, misfit in ((self.fit, error), (self.hold, held)):
            ratio = np.sqrt(np.divide(misfit, spread, out=np.ones(3), where=moving))
            fit[:] = np.maximum(100.0 * (1.0 - ratio), WORST_FIT)


WORST_FIT = -1000.0
"""Where the published fit ends, percent: below it the number says nothing more."""


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
