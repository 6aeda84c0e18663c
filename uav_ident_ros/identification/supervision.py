# SPDX-License-Identifier: Apache-2.0
"""Whether the coefficients may move, and how far to trust them: one plain verdict."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from uav_ident_ros.identification.estimators import Estimator
from uav_ident_ros.identification.gates import (
    TOO_FAR,
    TOO_QUIET,
    Gates,
    Look,
    ResidualGate,
    grounded,
)
from uav_ident_ros.identification.running_fit import RunningFit
from uav_ident_ros.identification.settings import Settings, SupervisionSettings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)

MIN_PREDICTIONS = 5
"""Predictions before the running fit counts."""

AXES = ("p", "q", "r")

RELEARNED_T_RATIO = 6.0
"""Value over sigma from which a coefficient that has changed is known again."""

RELEARNED_SIGMA = 2.0
"""Or sigma, relative to what it was before the change."""

SHORTEST_RELEARNING = 3.0
"""But not sooner than this after the change was noticed, s."""


class State(StrEnum):
    """What the identifier is doing, in a word."""

    WAITING = "waiting"
    LEARNING = "learning"
    CONVERGED = "converged"
    PAUSED = "paused"
    FAULT = "fault"


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


@dataclass(frozen=True)
class Change:
    """A coefficient that was found changed in flight.

    Parameters
    ----------
    name : str
        Its name, ``pdot/da`` and so on.
    t : float
        When it was noticed, s of message time.
    sigma : float
        Its standard deviation before.
    """

    name: str
    t: float
    sigma: float


class Supervisor:
    """Decides whether to learn, and gives the verdict on what was learned.

    Parameters
    ----------
    settings : Settings
        Gates and thresholds.
    structure : Structure
        Names the coefficients.

    Attributes
    ----------
    settings : Settings
        The parameter; it may change between ticks.
    adapt : bool
        Whether learning is switched on.
    armed : bool or None
        Whether the motors are armed; None if nothing was heard of it.
    gates : Gates
        The gates, and what each has cost.
    learning : (3,) bool array
        Rows that learned from the last block.
    changed : list of Change
        The changes found in flight, the oldest first.
    """

    def __init__(self, settings: Settings, structure: Structure) -> None:
        self.settings = settings
        self.adapt = settings.adapt_on_start
        self.armed: bool | None = None
        self._structure = structure
        self.gates = Gates(settings)
        self.reset()

    def reset(self) -> None:
        """Forget what is usual, and everything that was found."""
        self.changed: list[Change] = []
        self._relearning: dict[tuple[int, int], Change] = {}
        self._residuals = ResidualGate()
        self._within: BoolArray = np.ones(3, dtype=bool)
        self.learning: BoolArray = np.zeros(3, dtype=bool)
        self._quiet_time: FloatArray = np.zeros(3)
        self._sigma: FloatArray | None = None
        self._proven = False
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; what was found stays."""
        self.gates.restart()

    @property
    def closed(self) -> str:
        """Why nothing is learned at this tick; empty if no gate is closed."""
        return self.gates.closed

    def look(
        self,
        t: float,
        samples: FloatArray,
        raw: FloatArray,
        airspeed: float | None,
        implausible: str = "",
    ) -> None:
        """Show the signals of a tick to the gates; parameters as in `Look`."""
        look = Look(t, samples, raw, airspeed, self.armed, self.adapt, implausible, self.settings)
        self.gates.look(look)

    def grounded(self, airspeed: float | None) -> str:
        """Return why it does not fly, at an airspeed, m/s; empty if there is no reason."""
        armed_told = self.settings.armed.type != ""
        return grounded(self.armed, armed_told, airspeed, self.settings.supervision.min_airspeed)

    def weigh(self, residual: FloatArray, time: float, clear: BoolArray) -> FloatArray:
        """Return how much the samples of a tick count in each row, shape (3,), 0 ... 1.

        Parameters
        ----------
        residual : (m, 3) array
            Their residuals, rad/s^2.
        time : float
            Time that they stand for, s.
        clear : (3,) bool array
            Rows in which the inputs stand out from all else that moves the aircraft.
        """
        limit = self.settings.supervision.max_residual
        weight = self._residuals.weigh(residual, time, limit, clear)
        if not self._proven:
            weight = np.ones(3)  # what was never good must be free to change at once
        self._within = weight > 0.0
        return weight

    def follow(self, t: float, estimator: Estimator, learned: bool, dt: float) -> None:
        """Take note of what the estimator made of a block of `dt` s that ends at `t` s."""
        self.learning = estimator.learning & learned
        if learned:
            held = ~self._within
            self.gates.charge("residual", float(held.mean()))
            self.gates.charge("excitation", float((~self.learning & ~held).mean()))
        self._quiet_time = np.where(self.learning, 0.0, self._quiet_time + dt)
        if not learned:
            return
        for i, j in estimator.changes:
            before = float("inf") if self._sigma is None else float(self._sigma[i, j])
            change = Change(f"{ROWS[i]}/{self._structure.regressors[j]}", t, before)
            self._relearning[i, j] = change
            self.changed.append(change)
            self._residuals.release(i)

    def pauses(self) -> dict[str, str]:
        """Return why each row that does not learn pauses: row to reason."""
        if self.closed:
            return dict.fromkeys(ROWS, self.closed)
        return {
            row: TOO_QUIET if within else TOO_FAR
            for row, learning, within in zip(ROWS, self.learning, self._within, strict=True)
            if not learning
        }

    def judge(
        self, t: float, coefficients: FloatArray, sigma: FloatArray, running: RunningFit
    ) -> Verdict:
        """Give the verdict on the coefficients at `t` s; parameters as in `judge`."""
        self._sigma = sigma
        for (i, j), change in list(self._relearning.items()):
            enough = max(
                RELEARNED_SIGMA * change.sigma, abs(float(coefficients[i, j])) / RELEARNED_T_RATIO
            )
            if t - change.t > SHORTEST_RELEARNING and sigma[i, j] <= enough:
                del self._relearning[i, j]
        if self._relearning:
            names = ", ".join(change.name for change in self._relearning.values())
            verdict = Verdict(False, f"{names} changed in flight and is learned anew")
        else:
            age = float(self._quiet_time.max())
            thresholds = self.settings.supervision
            verdict = judge(thresholds, self._structure, coefficients, sigma, running, age)
        self._proven = self._proven or verdict.usable
        return verdict

    def state(self, verdict: Verdict) -> tuple[State, str]:
        """Return the state word, and why it is not learning or not usable."""
        if self.closed:
            return State.PAUSED, self.closed
        if not self.learning.any():
            return State.PAUSED, " and ".join(sorted(set(self.pauses().values())))
        if verdict.usable:
            return State.CONVERGED, ""
        return State.LEARNING, verdict.reason


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
