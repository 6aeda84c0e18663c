# SPDX-License-Identifier: Apache-2.0
"""Whether the coefficients may move, and how far to trust them: one plain verdict."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.estimators import Estimator
from uav_ident_ros.identification.estimators.excitation import WINDOW_TIME
from uav_ident_ros.identification.estimators.model_error import sigma_without_error
from uav_ident_ros.identification.gates import TOO_FAR, TOO_QUIET, Gate, Gates, ResidualGate
from uav_ident_ros.identification.parallel_model import RunningFit
from uav_ident_ros.identification.residuals import Confirmation
from uav_ident_ros.identification.scales import MEMORY
from uav_ident_ros.identification.settings import Settings, SupervisionSettings
from uav_ident_ros.identification.structure import (
    MAIN_DERIVATIVES,
    MAIN_INPUTS,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)

JUDGED_FROM = MEMORY
"""Time of learning from which a cold start is judged, s. Lag, delay and saturation that nobody told
have shown by then: after 10 to 28 s on two aircraft (benchmarks/false_usable.py, unmodelled), since
`ModelError` needs more blocks of a second than the eleven coefficients that it solves for."""

AXES = ("p", "q", "r")


class State(StrEnum):
    """What the identifier is doing, in a word."""

    WAITING = "waiting"
    LEARNING = "learning"
    CONVERGED = "converged"
    PAUSED = "paused"
    FAULT = "fault"


Verdict = tuple[str, str, str]
"""For each of pdot, qdot, rdot why a controller may not act on it, in a sentence; empty where it
may."""


class Change(NamedTuple):
    """A coefficient that was found changed in flight, or told wrong."""

    name: str  # ``pdot/da`` and so on
    prior_rejected: bool
    t: float  # When it was noticed, s of message time
    sigma: float  # Its standard deviation before


class Supervisor:
    """Decides whether to learn, and gives the verdict on what was learned."""

    def __init__(
        self,
        settings: Settings,
        structure: Structure,
        more: Sequence[Gate] = (),  # Gates of one's own
    ) -> None:
        self.settings = settings  # The parameter; it may change between ticks
        self.adapt = settings.adapt_on_start  # Whether learning is switched on
        self.armed: bool | None = None  # Whether the motors are; None if nothing was heard of it
        self._structure = structure
        self.gates = Gates(more)
        self.reset()

    def reset(self) -> None:
        """Forget what is usual, and everything that was found."""
        # The changes found in flight, and what was told wrong, the oldest first
        self.changed: list[Change] = []
        self._relearning: dict[tuple[int, int], Change] = {}
        self._residuals = ResidualGate()
        self._within: BoolArray = np.ones(3, dtype=bool)
        self._learned: BoolArray = np.ones(3, dtype=bool)
        self.confirmed = Confirmation()  # Of control derivatives, by the flight
        self._sigma: FloatArray = np.full(self._structure.mask.shape, np.inf)
        self.proven = False  # Whether all rows have been usable since the start
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; what was found stays."""
        self.gates.restart()

    def weigh(
        self,
        residual: FloatArray,  # (m, 3) Of the samples of a tick, rad/s^2
        time: float,  # Time that they stand for, s
        clear: BoolArray,  # (3,) Rows in which the inputs stand out from all else that moves it
    ) -> FloatArray:
        """Return how much the samples of a tick count in each row, shape (3,), 0 ... 1."""
        limit = self.settings.supervision.max_residual
        weight = self._residuals.weigh(residual, time, limit, clear)
        if not self.proven:
            weight = np.ones(3)  # what was never good must be free to change at once
        self._within = weight > 0.0
        return weight

    @property
    def learning(self) -> BoolArray:
        """Rows that learn, shape (3,)."""
        return self._learned & (not self.gates.closed)

    def follow(self, t: float, estimator: Estimator, ticks: int) -> None:
        """Take note of what the estimator made of a stretch of some ticks that ends at `t` s."""
        self._learned = estimator.learning
        within, learned_rows = self._within.tolist(), self._learned.tolist()
        quiet = sum(w and not row for w, row in zip(within, learned_rows, strict=True))
        self.gates.charge("residual", ticks * within.count(False) / len(ROWS))
        self.gates.charge("excitation", ticks * quiet / len(ROWS))
        for i, j in estimator.changes:
            name = f"{ROWS[i]}/{self._structure.regressors[j]}"
            prior_rejected = (i, j) in estimator.rejected
            change = Change(name, prior_rejected, t, float(self._sigma[i, j]))
            self._relearning[i, j] = change
            self.changed.append(change)
            self._residuals.release(i)
            self.confirmed.forget(i)

    def pauses(self) -> dict[str, str]:
        """Return why each row that does not learn pauses: row to reason."""
        if self.gates.closed:
            return dict.fromkeys(ROWS, self.gates.closed)
        return {
            row: TOO_QUIET if within else TOO_FAR
            for row, learning, within in zip(ROWS, self.learning, self._within, strict=True)
            if not learning
        }

    def judge(
        self,
        t: float,  # s
        coefficients: FloatArray,  # (R, n)
        sigma: FloatArray,  # (R, n)
        running: RunningFit,
        # (3,) What the main inputs do otherwise than the model says, relative to their effect
        model_error: FloatArray,
        denied: Sequence[str],  # What speaks against each row beforehand; empty if nothing does
        learned_time: float,  # Since a cold start, s; inf after a warm one
    ) -> Verdict:
        """Give the verdict on the coefficients, row by row.

        Usable is a row that predicts the next second clearly better than holding the rate does, of
        late and over the flight, whose main control derivative is known well, and was confirmed by
        what its input did not long ago.
        """
        self._sigma = sigma
        young = "" if running.predictions else "no prediction of one second is complete yet"
        if learned_time < JUDGED_FROM:
            young = f"{int(learned_time)} s of learning, {JUDGED_FROM:g} s are needed for a verdict"
        settings = self.settings.supervision
        main, spread = coefficients[MAIN_DERIVATIVES], sigma[MAIN_DERIVATIVES]
        beside = sigma_without_error(spread, main, model_error)
        relearning: dict[int, str] = {}
        for (i, j), change in list(self._relearning.items()):
            known = settings.min_t_ratio * sigma[i, j] <= abs(coefficients[i, j])
            known = known or sigma[i, j] <= change.sigma
            # sigma is small sooner, but from the samples by which the change was chosen
            if known and t - change.t > WINDOW_TIME:
                del self._relearning[i, j]
            else:
                why = "is not what was told" if change.prior_rejected else "changed in flight"
                relearning[i] = f"{change.name} {why} and is learned anew"
        first, second, third = (
            relearning.get(i)
            or denied[i]
            or young
            or _poor_fit(settings, running, i)
            or _unknown_input(settings, i, main.item(i), beside.item(i))  # late or not
            or _incomplete(i, float(model_error[i]), settings.min_t_ratio)
            or _unknown_input(settings, i, main.item(i), spread.item(i))
            or self.confirmed.doubt(i)
            for i in range(len(ROWS))
        )
        self.proven = self.proven or not (first or second or third)
        return first, second, third

    def state(self, verdict: Verdict) -> tuple[State, str]:
        """Return the state word, and why it is not learning or not usable."""
        if self.gates.closed:
            return State.PAUSED, self.gates.closed
        reason = "; ".join(dict.fromkeys(filter(None, verdict)))
        if True not in self._learned.tolist():
            reasons = [*sorted(set(self.pauses().values())), reason]
            return State.PAUSED, "; ".join(filter(None, reasons))
        return State.LEARNING if reason else State.CONVERGED, reason


def _poor_fit(settings: SupervisionSettings, running: RunningFit, i: int) -> str:
    """Return how an axis is predicted too badly; empty if it is not."""
    for when, fit, hold in (
        ("of late", running.fit.item(i), running.hold.item(i)),
        ("over the flight", running.flight_fit.item(i), running.flight_hold.item(i)),
    ):
        needed = max(settings.min_fit, hold)
        if not fit >= needed:
            return (
                f"the 1-second prediction fit of {AXES[i]} {when} is {fit:.0f} % "
                f"(holding the rate: {hold:.0f} %, needed: {needed:.0f} %)"
            )
    return ""


def _unknown_input(settings: SupervisionSettings, row: int, value: float, sigma: float) -> str:
    """Return how the main control derivative of a row is not known; empty if it is."""
    ratio = abs(value) / sigma if sigma > 0.0 else (np.inf if value else 0.0)
    needed, name, move = settings.min_t_ratio, ROWS[row], MAIN_INPUTS[ROWS[row]]
    if ratio >= needed:
        return ""
    return f"{name}/{move} has a t-ratio of {ratio:.1f} ({needed:.1f} needed): move {move}"


def _incomplete(row: int, share: float, t_ratio: float) -> str:
    """Return how the model of a row misses what its input does; empty if it does not.

    A share of 1 in `t_ratio` may come late, early, or stop short, as much as chance and wrong
    settings may falsify. At the default, 4, servo lags, delays and limits of travel that halve a
    control derivative take 0.33 to 0.9, a delay of 25 ms up to 0.2, and what is right nothing; a
    lag of 0.1 s that is told and not there 0.4 and more.
    """
    if share * t_ratio <= 1.0:
        return ""
    surface = MAIN_INPUTS[ROWS[row]]
    return (
        f"{ROWS[row]} follows {surface} badly: {100.0 * min(share, 1.0):.0f} % of the effect is "
        "late, early, or missing at large or quick deflections (a servo lag, a delay or a limit of "
        "travel); "
        "correct 'actuators.time_constant', 'actuators.delay' or 'actuators.upper_limit'"
    )
