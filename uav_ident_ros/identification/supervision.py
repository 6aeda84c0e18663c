# SPDX-License-Identifier: Apache-2.0
"""Supervision: running fit, weights of the rows, and the verdict on the coefficients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
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
)
from uav_ident_ros.identification.model import IdentifiedModel, bounded
from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.regression import layout
from uav_ident_ros.identification.residuals import Confirmation
from uav_ident_ros.identification.sampling import Block, join
from uav_ident_ros.identification.scales import LONG_MEMORY, MEMORY, OUTLYING, SHORT_MEMORY
from uav_ident_ros.identification.settings import Settings, SupervisionSettings
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUTS,
    MAIN_DERIVATIVES,
    MAIN_INPUTS,
    RATES,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)

JUDGED_FROM = MEMORY
"""Learning time before the verdict of a cold start, s. By then unmodelled lag, delay and saturation
are detected: after 10 to 28 s on two aircraft (benchmarks/false_usable.py, unmodelled).
`ModelError` needs more blocks of a second than the eleven coefficients that it solves for."""


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


# --- running fit ----------------------------------------------------------------------------------


FAILED_PREDICTION = 4.0
"""Squared error of a failed prediction, relative to the signal's variation: that of the negative of
the measurement, a fit of -100 percent. A larger error counts as this one."""

# The sums over samples: count, x, x^2, then squared errors.
_SPREAD, _ERRORS, _MODEL, _HOLD, _SAVED = slice(0, 3), slice(3, 6), 3, 4, 5


class RunningFit:
    """Free 1-second prediction fit of the coefficients in use, of those saved, and of holding.

    Predictions follow one another. Each starts from the measured state, with the coefficients of
    that time, and runs on the measured inputs only. It is compared with every sample of its second.
    """

    def __init__(self, structure: Structure, model: IdentifiedModel) -> None:
        self._holds_force = structure.has_forces
        self._model = model
        # Fit of p, q, r in percent, of the coefficients in use, of the rates held, and of the saved
        # coefficients; 0 before the first prediction
        self.fit: FloatArray = np.zeros(3)
        self.hold: FloatArray = np.zeros(3)
        self.saved: FloatArray = np.zeros(3)
        self.predictions = 0  # Counted so far
        self._sums: FloatArray = np.zeros((6, 3))
        self.forget()

    def restart(self) -> None:
        """Drop the prediction under way."""
        self._parts: list[Block] = []
        self._time = 0.0

    def forget(self) -> None:
        """Clear the sums after a change of the aircraft; `fit` stays until the next prediction."""
        self.restart()
        self._age = 0.0
        self._sums.fill(0.0)

    def save(self) -> None:
        """Note that the coefficients in use are saved: up to now both have the same errors."""
        self._sums[_SAVED] = self._sums[_MODEL]

    def add(
        self,
        block: Block,
        coefficients: FloatArray,  # (R, n) In use at the start of the block
        saved: FloatArray | None,  # (R, n) Last saved
    ) -> None:
        """Add a block of signals; evaluate the prediction of each full second."""
        if block.restarted:
            self.restart()
        if not self._parts:
            self._coefficients, self._saved = coefficients, saved
        self._parts.append(block)
        self._time += block.time
        if self._time < HORIZONS[0] - 0.5 * block.h:
            return
        second = join(self._parts)
        if self._holds_force:
            held = np.broadcast_to(second.specific_force[:1], second.specific_force.shape)
            second = replace(second, specific_force=held)
        x, now = second.x[1:], np.zeros((6, 3))
        now[_SPREAD] = np.full(3, len(x)), x.sum(axis=0), (x * x).sum(axis=0)
        now[_HOLD] = ((x - second.x[0]) ** 2).sum(axis=0)
        now[_MODEL] = self._error(second, self._coefficients)
        if self._saved is not None:
            now[_SAVED] = self._error(second, self._saved)
        self.predictions += 1
        self._age += self._time
        sums = self._sums
        sums *= np.exp(-self._time / min(MEMORY, 0.5 * self._age))
        sums += now
        spread = _spread(sums)
        failed = FAILED_PREDICTION * np.maximum(_spread(now), spread * now[0] / sums[0])
        sums[_ERRORS] -= np.maximum(now[_ERRORS] - failed, 0.0)
        ratio = np.divide(sums[_ERRORS], spread, out=np.ones((3, 3)), where=spread > 0.0)
        self.fit, self.hold, self.saved = 100.0 * (1.0 - np.sqrt(ratio))
        if self._saved is None:
            self.saved = np.zeros(3)
        self.restart()

    def _error(self, second: Block, coefficients: FloatArray) -> FloatArray:
        """Return the sum of the squared errors of a prediction, shape (3,)."""
        states = self._model.propagate(coefficients, second, second.state[0])
        return np.asarray(((second.x - bounded(states)[:, :3])[1:] ** 2).sum(axis=0))


def _spread(sums: FloatArray) -> FloatArray:
    """Return the sum of the squared deviations from the mean, shape (3,)."""
    count, total, square = sums[_SPREAD]
    return np.asarray(np.maximum(square - total * total / count, 0.0))


# --- supervisor -----------------------------------------------------------------------------------


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
        self._structure, self._layout = structure, layout(structure)
        self.gates = Gates(more)
        self.reset()

    def reset(self) -> None:
        """Discard residual statistics, detected changes and confirmations."""
        # Coefficients changed in flight or with a contradicted initial value, oldest first
        self.changed: list[Change] = []
        self._relearning: dict[tuple[int, int], Change] = {}
        self._usual = [0.0] * len(ROWS)  # Mean squares of the residuals, rad^2/s^4
        self._usual_time = [0.0] * len(ROWS)  # Time over which they were taken, s
        self._within: BoolArray = np.ones(3, dtype=bool)
        self._learned: BoolArray = np.ones(3, dtype=bool)
        self.confirmed = Confirmation(self._layout)
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
        """Return the weight of the samples of a tick in each row, shape (3,), 0 ... 1.

        The weight falls with the size of the residual. It is zero far above the usual size, or
        where the effect of the inputs does not exceed the disturbance, as in a storm with feedback.
        The usual size grows slowly, and never in a storm.
        """
        limit = self.settings.supervision.max_residual
        squares = (np.add.reduce(residual * residual) / len(residual)).tolist()
        weights = []
        for i, (square, stands_out) in enumerate(zip(squares, clear.tolist(), strict=True)):
            usual = self._usual[i] if self._usual_time[i] >= SHORT_MEMORY else math.inf
            self._usual_time[i] = min(self._usual_time[i] + time, LONG_MEMORY)
            clipped = min(square, OUTLYING * usual if stands_out else usual)
            self._usual[i] += time / self._usual_time[i] * (clipped - self._usual[i])
            if limit <= 0.0 or square <= OUTLYING * usual:
                weights.append(1.0)
            elif stands_out and square <= limit * limit * usual:
                weights.append(OUTLYING * usual / square)
            else:
                weights.append(0.0)
        # Coefficients that were never usable must converge freely.
        weight = np.array(weights) if self.proven else np.ones(3)
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
        self.gates.lost["residual"] += ticks * within.count(False) / len(ROWS)
        self.gates.lost["excitation"] += ticks * quiet / len(ROWS)
        for i, j in estimator.changes:
            name = f"{ROWS[i]}/{self._structure.regressors[j]}"
            prior_rejected = (i, j) in estimator.rejected
            change = Change(name, prior_rejected, t, float(self._sigma[i, j]))
            if j != CONSTANT_COLUMN:  # at another trim the derivatives hold
                self._relearning[i, j] = change
            self.changed.append(change)
            self._usual_time[i] = 0.0
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
        estimator: Estimator,  # Source of the model errors
        denied: Sequence[str],  # Reason against each row by wrong settings; empty if none
        learned_time: float,  # Since a cold start, s; inf after a warm one
        axes: str = "",  # Reason against all rows while other axes of the gyro are more likely
    ) -> None:
        """Renew the verdict on the coefficients, row by row.

        A row is usable if it has lately predicted the next second better than holding the rate
        does. Its main control derivative must have a small sigma, and must have been confirmed
        recently by the motion of its input. Evidence against one that is not known is cleared. The
        yaw of an aircraft without a rudder has no such derivative: its prediction alone counts.
        """
        self._sigma = sigma
        young = "" if running.predictions else "no prediction of one second is complete yet"
        if learned_time < JUDGED_FROM:
            young = f"{int(learned_time)} s of learning, {JUDGED_FROM:g} s are needed for a verdict"
        settings = self.settings.supervision
        main, spread = coefficients[MAIN_DERIVATIVES], sigma[MAIN_DERIVATIVES]
        beside = sigma_without_error(spread, main, estimator.sure_error)
        unknown = [
            _unknown_input(settings, i, main.item(i), spread.item(i), estimator.answers)
            for i in range(len(ROWS))
        ]
        effects, spreads = coefficients[self._layout.effects], sigma[self._layout.effects]
        known = (np.abs(effects) >= settings.min_t_ratio * spreads) & (effects != 0.0)
        self.confirmed.forget_contradictions(~known)
        relearning = self._relearned(t, coefficients, sigma)

        def of_input(i: int) -> str:
            """Return the reason against a row by its main input; empty if there is none."""
            if not self.settings.actuators.has(MAIN_INPUTS[ROWS[i]]):
                return ""
            return (
                # late or not
                _unknown_input(settings, i, main.item(i), beside.item(i), estimator.answers)
                or _incomplete(
                    i,
                    float(estimator.model_error[i]),
                    settings.min_t_ratio,
                    multirotor=self.settings.actuators.multirotor,
                )
                or unknown[i]
                or self.confirmed.doubt(i)
            )

        self.verdict = tuple(
            relearning.get(i)
            or denied[i]
            or young
            or _poor_fit(settings, running, i)
            or of_input(i)
            or axes
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
        f"the 1-second prediction fit of {RATES[i]} of late is {fit:.0f} % "
        f"(holding the rate: {hold:.0f} %, needed: {needed:.0f} %)"
    )


def _unknown_input(
    settings: SupervisionSettings,
    row: int,
    value: float,
    sigma: float,
    answers: FloatArray,  # (4,) Share of each input that answers disturbances
) -> str:
    """Return the reason against a row if its main control derivative is unknown; else empty."""
    ratio = abs(value) / sigma if sigma > 0.0 else (np.inf if value else 0.0)
    needed, name, move = settings.min_t_ratio, ROWS[row], MAIN_INPUTS[ROWS[row]]
    if ratio >= needed:
        return ""
    reason = f"{name}/{move} has a t-ratio of {ratio:.1f} ({needed:.1f} needed): move {move}"
    if share := answers.item(INPUTS.index(move)):
        reason += f" by itself, {100.0 * share:.0f} % of its motion answers disturbances (~/excite)"
    return reason


def _incomplete(row: int, share: float, t_ratio: float, *, multirotor: bool = False) -> str:
    """Return the reason against a row if its model error is too large; else empty.

    The error is the share of the input's effect that is late, early or missing. The limit is
    1 / `t_ratio`, as for sigma and for the bias by wrong settings: 0.25 by default. Lags, delays,
    backlash and limits of travel that halve a control derivative give 0.33 to 0.9, a delay of 25 ms
    up to 0.2, a configured lag of 0.1 s that does not exist 0.4 and more. Correct settings give 0
    with excitation throughout, with little of it the noise of the lateness.
    """
    if share * t_ratio <= 1.0:
        return ""
    surface, move = MAIN_INPUTS[ROWS[row]], "the surfaces"
    causes = "a servo lag, a delay, backlash, a dead band, a limit of travel or of servo speed"
    if multirotor:
        causes, move = "a motor lag, a delay, a limit of thrust", surface
        if ROWS[row] == "rdot":
            causes += (
                ", or the inertia of the rotors, which yaws the vehicle before their drag does"
            )
    return (
        f"{ROWS[row]} follows {surface} badly: {100.0 * min(share, 1.0):.0f} % of the effect is "
        f"late, early, or missing at small, large or quick deflections ({causes}); correct "
        "'actuators.time_constant', 'actuators.delay' or 'actuators.upper_limit', or move "
        f"{move} more slowly"
    )
