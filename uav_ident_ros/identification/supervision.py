# SPDX-License-Identifier: Apache-2.0
"""Supervision: the weights of the rows, and the verdict on the coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.estimators import Estimator
from uav_ident_ros.identification.estimators.model_error import sigma_without_error
from uav_ident_ros.identification.gates import (
    EXCITATION_TIME,
    TOO_FAR,
    TOO_QUIET,
    Gate,
    Gates,
    ResidualGate,
)
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
"""Learning time before the verdict of a cold start, s. By then unmodelled lag, delay and saturation
are detected: after 10 to 28 s on two aircraft (benchmarks/false_usable.py, unmodelled).
`ModelError` needs more blocks of a second than the eleven coefficients that it solves for."""

AXES = ("p", "q", "r")


class State(StrEnum):
    """State of the identifier."""

    WAITING = "waiting"
    LEARNING = "learning"
    CONVERGED = "converged"
    PAUSED = "paused"
    FAULT = "fault"


class Change(NamedTuple):
    """A coefficient that changed in flight, or whose initial value the flight contradicts."""

    name: str  # ``pdot/da`` and so on
    prior_rejected: bool
    t: float  # Message time of its detection, s
    sigma: float  # Its standard deviation before


class Supervisor:
    """Gates, weights of the rows, and the verdict on the coefficients."""

    def __init__(
        self,
        settings: Settings,
        structure: Structure,
        more: Sequence[Gate] = (),  # Additional gates
    ) -> None:
        self.settings = settings  # May be replaced between ticks
        self.adapt = settings.adapt_on_start  # Whether learning is switched on
        self.armed: bool | None = None  # Whether the motors are; None if no message has arrived
        self._structure = structure
        self.gates = Gates(more)
        self.reset()

    def reset(self) -> None:
        """Discard residual statistics, detected changes and confirmations."""
        # Coefficients changed in flight or with a contradicted initial value, oldest first
        self.changed: list[Change] = []
        self._relearning: dict[tuple[int, int], Change] = {}
        self._residuals = ResidualGate()
        self._within: BoolArray = np.ones(3, dtype=bool)
        self._learned: BoolArray = np.ones(3, dtype=bool)
        self.confirmed = Confirmation()  # Of the main control derivatives, by the flight
        self._sigma: FloatArray = np.full(self._structure.mask.shape, np.inf)
        # Reason why a controller may not use each row; empty where it is usable
        self.verdict: tuple[str, ...] = ("",) * len(ROWS)
        self.proven = False  # Whether all rows have been usable since the start
        self.gates.restart()

    def weigh(
        self,
        residual: FloatArray,  # (m, 3) Of the samples of a tick, rad/s^2
        time: float,  # Time that they cover, s
        clear: BoolArray,  # (3,) Rows in which the effect of the inputs exceeds the disturbance
    ) -> FloatArray:
        """Return the weight of the samples of a tick in each row, shape (3,), 0 ... 1."""
        limit = self.settings.supervision.max_residual
        weight = self._residuals.weigh(residual, time, limit, clear)
        if not self.proven:
            weight = np.ones(3)  # coefficients that were never usable must converge freely
        self._within = weight > 0.0
        return weight

    @property
    def learning(self) -> BoolArray:
        """Rows that learn, shape (3,)."""
        return self._learned & (not self.gates.closed)

    def follow(self, t: float, estimator: Estimator, ticks: int) -> None:
        """Record learning rows and detected changes of an update over some ticks, up to `t` s."""
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
        """Return the reason to pause of each row that does not learn, by row."""
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
        # (3,) Unmodelled response to each main input, relative to the effect of that input
        model_error: FloatArray,
        denied: Sequence[str],  # Reason against each row by wrong settings; empty if none
        learned_time: float,  # Since a cold start, s; inf after a warm one
    ) -> None:
        """Renew the verdict on the coefficients, row by row.

        A row is usable if it has lately predicted the next second better than holding the rate
        does. Its main control derivative must have a small sigma, and must have been confirmed
        recently by the motion of its input. Evidence against one that is not known is cleared.
        """
        self._sigma = sigma
        young = "" if running.predictions else "no prediction of one second is complete yet"
        if learned_time < JUDGED_FROM:
            young = f"{int(learned_time)} s of learning, {JUDGED_FROM:g} s are needed for a verdict"
        settings = self.settings.supervision
        main, spread = coefficients[MAIN_DERIVATIVES], sigma[MAIN_DERIVATIVES]
        beside = sigma_without_error(spread, main, model_error)
        unknown = [
            _unknown_input(settings, i, main.item(i), spread.item(i)) for i in range(len(ROWS))
        ]
        for i, doubt in enumerate(unknown):
            if doubt:
                self.confirmed.forget_contradictions(i)
        relearning = self._relearned(t, coefficients, sigma)
        self.verdict = tuple(
            relearning.get(i)
            or denied[i]
            or young
            or _poor_fit(settings, running, i)
            or _unknown_input(settings, i, main.item(i), beside.item(i))  # late or not
            or _incomplete(i, float(model_error[i]), settings.min_t_ratio)
            or unknown[i]
            or self.confirmed.doubt(i)
            for i in range(len(ROWS))
        )
        self.proven = self.proven or not any(self.verdict)

    def _relearned(self, t: float, coefficients: FloatArray, sigma: FloatArray) -> dict[int, str]:
        """Return the reason against each row with a coefficient that is learned anew."""
        reasons: dict[int, str] = {}
        for (i, j), change in list(self._relearning.items()):
            known = self.settings.supervision.min_t_ratio * sigma[i, j] <= abs(coefficients[i, j])
            known = known or sigma[i, j] <= change.sigma
            # sigma is small before that, but from the samples that selected the change
            if known and t - change.t > EXCITATION_TIME:
                del self._relearning[i, j]
            else:
                why = "contradicts its prior" if change.prior_rejected else "changed in flight"
                reasons[i] = f"{change.name} {why} and is learned anew"
        return reasons

    def state(self) -> tuple[State, str]:
        """Return the state, and the reason why it is not learning or not usable."""
        if self.gates.closed:
            return State.PAUSED, self.gates.closed
        reason = "; ".join(dict.fromkeys(filter(None, self.verdict)))
        if True not in self._learned.tolist():
            reasons = [*sorted(set(self.pauses().values())), reason]
            return State.PAUSED, "; ".join(filter(None, reasons))
        return State.LEARNING if reason else State.CONVERGED, reason


def _poor_fit(settings: SupervisionSettings, running: RunningFit, i: int) -> str:
    """Return the reason against an axis by its prediction fit; empty if there is none."""
    fit, hold = running.fit.item(i), running.hold.item(i)
    needed = max(settings.min_fit, hold)
    if fit >= needed:
        return ""
    return (
        f"the 1-second prediction fit of {AXES[i]} of late is {fit:.0f} % "
        f"(holding the rate: {hold:.0f} %, needed: {needed:.0f} %)"
    )


def _unknown_input(settings: SupervisionSettings, row: int, value: float, sigma: float) -> str:
    """Return the reason against a row if its main control derivative is unknown; else empty."""
    ratio = abs(value) / sigma if sigma > 0.0 else (np.inf if value else 0.0)
    needed, name, move = settings.min_t_ratio, ROWS[row], MAIN_INPUTS[ROWS[row]]
    if ratio >= needed:
        return ""
    return f"{name}/{move} has a t-ratio of {ratio:.1f} ({needed:.1f} needed): move {move}"


def _incomplete(row: int, share: float, t_ratio: float) -> str:
    """Return the reason against a row if its model error is too large; else empty.

    The error is the share of the input's effect that is late, early or missing. The limit is
    1 / `t_ratio`, as for sigma and for the bias by wrong settings: 0.25 by default. Lags, delays
    and limits of travel that halve a control derivative give 0.33 to 0.9, a delay of 25 ms up to
    0.2, a configured lag of 0.1 s that does not exist 0.4 and more. Correct settings give 0 with
    excitation throughout, with little of it the noise of the lateness.
    """
    if share * t_ratio <= 1.0:
        return ""
    surface = MAIN_INPUTS[ROWS[row]]
    return (
        f"{ROWS[row]} follows {surface} badly: {100.0 * min(share, 1.0):.0f} % of the effect is "
        "late, early, or missing at large or quick deflections (a servo lag, a delay, a limit of "
        "travel or of servo speed); correct 'actuators.time_constant', 'actuators.delay' or "
        "'actuators.upper_limit', or move the surfaces more slowly"
    )
