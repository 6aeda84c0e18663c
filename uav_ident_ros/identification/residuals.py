# SPDX-License-Identifier: Apache-2.0
"""Noise, feedback and confirmation from the residuals of each row.

Gusts and the model's own errors are slow, and an autopilot answers them. An autoregressive model of
the residual whitens it, and with it regressors, instruments and inputs (prewhitening; Box, Jenkins
and Reinsel, Time Series Analysis, 2008).
"""

from __future__ import annotations

import math
from collections import deque
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.regression import Layout, Regression, RowSamples, diagonal
from uav_ident_ros.identification.scales import (
    GUST_TIME,
    INDEPENDENT_TIME,
    LONG_MEMORY,
    LOOK_TIME,
    MEMORY,
    RESPONSE_TIME,
    ROUNDING,
    SAMPLE_TIME,
    SURE,
    TINY,
)
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    MAIN_INPUTS,
    MAIN_PLACES,
    ROWS,
    BoolArray,
    FloatArray,
)

ORDER = 3
"""Order of the autoregression, samples: gusts of first order behind a filter of second order."""

LOADING = 0.01
"""White noise added to the autocovariances, relative to the variance. It keeps the whitened part of
a slow input above the errors of rounding and sampling."""


class Autoregression:
    """Autoregressive models of signals of several rows: of the residuals, or of inputs."""

    def __init__(self, rows: int) -> None:
        # Weights of the past residuals in the prediction, the newest first
        self.weights: FloatArray = np.zeros((rows, ORDER))
        self.variance: FloatArray = np.zeros(rows)  # Of the innovations
        self._covariances: FloatArray = np.zeros((rows, ORDER + 1))
        self._time = self._since_fit = 0.0
        self._lags = np.abs(np.subtract.outer(np.arange(ORDER), np.arange(ORDER)))
        # Matrices from `ORDER` + m signals to m innovations, (rows, m, `ORDER` + m)
        self._matrices: dict[int, FloatArray] = {}
        self._past: FloatArray | None = None
        self._known = 0

    def whiten(self, new: FloatArray, dt: float, *, restarted: bool) -> FloatArray:
        """Update the model with signals (rows, m, k), and return what their past does not predict.

        The first of the k is the one that the model is of; whitened, it is the innovation. After a
        restart, where the first sample does not continue the last, zeros take the place of the
        first `ORDER`.
        """
        if restarted or self._past is None:
            self._past, self._known = np.zeros((len(new), ORDER, new.shape[2])), 0
        signals = np.concatenate((self._past, new), axis=1)
        self._past = signals[:, -ORDER:]
        m = new.shape[1]
        self._time += m * dt
        share = min(m * dt / min(self._time, MEMORY), 1.0)
        first = signals[:, :, 0]
        products = (first[:, _lags(m)] @ first[:, ORDER:, None])[:, :, 0]
        self._covariances += share * (products / m - self._covariances)
        self._since_fit += m * dt
        if self._since_fit >= LOOK_TIME:
            self._since_fit = 0.0
            # The Yule-Walker equations
            c = self._covariances
            matrix = c.take(self._lags, axis=1)
            level = np.maximum(c[:, 0], TINY)
            diagonal(matrix)[...] += (LOADING * level)[:, None]
            self.weights = np.linalg.solve(matrix, c[:, 1:, None])[:, :, 0]
            self._matrices.clear()
            left = c[:, 0] - (self.weights * c[:, 1:]).sum(axis=1)
            self.variance = np.maximum(left, LOADING * c[:, 0])
        if m not in self._matrices:
            matrix = self._matrices[m] = np.zeros((len(self.weights), m, ORDER + m))
            for k in range(m):
                matrix[:, k, k : k + ORDER] = -self.weights[:, ::-1]
                matrix[:, k, k + ORDER] = 1.0
        white = self._matrices[m] @ signals
        if self._known < ORDER:
            white[:, : ORDER - self._known] = 0.0
            self._known += m
        return np.asarray(white)


@lru_cache(maxsize=64)
def _lags(m: int) -> NDArray[np.intp]:
    """Return places of the m newest of `ORDER` + m samples and of those before, a lag a row."""
    return np.add.outer(np.arange(ORDER, -1, -1), np.arange(m))


# --- feedback -------------------------------------------------------------------------------------


ANSWER_TIMES = np.geomspace(2.0 * SAMPLE_TIME, RESPONSE_TIME, 3)
"""Time constants of the fading past residuals, s: from a rate loop, as fast as the samples allow,
to an attitude loop."""


UNKNOWN_ANSWER = np.full(len(ROWS), 1.0 / ROUNDING)
"""`Feedback.largest_answer` before there is any: as good as infinite."""


def by_plane(squares: FloatArray) -> FloatArray:
    """Return the mean squares of each row's plane, (3,): roll and yaw have one."""
    across = squares[0] + squares[2]
    return np.array([across, squares[1], across])


class Feedback:
    """Share of the inputs that past residuals explain: feedback, which is no information.

    A gust moves the aircraft, an autopilot answers, and the input is correlated with the gust w. No
    residual shows this, and no time averages it away. But the answer comes later than the gust:
    past residuals explain a share R^2 of an input with feedback, and nothing of one without (the
    test of residuals against future inputs; Ljung, System Identification, 1999, ch. 13 and 16).
    Over a time T the sum of ``z w``, which biases the estimate, is therefore at most (Cauchy and
    Schwarz)

        C = T sigma_w^2 S, S = sum R^2 z z^T,

    where the sum of independent disturbances has a correlation time in place of T. The residual
    shows the part of w that is not yet in the estimate (`Information.spread`).

    No loop answers a gust with more motion than the gust makes. A share that would do so may be
    chance, since both signals are slow, or the error of a poor model. It counts only if past
    residuals also improve on the prediction from the past of all inputs (Granger, Econometrica 37,
    1969). Effects that the structure does not have are in the residual, as with a turned Imu: it
    then repeats that past.
    """

    def __init__(self, layout: Layout) -> None:
        self._driven_by = layout.driven_by
        # Fading sums of past residuals and inputs
        self._past: FloatArray = np.zeros((len(ANSWER_TIMES), len(ROWS) + len(INPUTS)))
        self._answers = len(ANSWER_TIMES) * len(ROWS) + 1  # Past residuals, and the constant
        self._inputs = slice(self._answers, self._answers + len(INPUTS))
        self._gusts = slice(self._inputs.stop, self._inputs.stop + len(ROWS))
        self._before: FloatArray = np.zeros((ORDER, len(INPUTS)))  # The newest last
        size = self._gusts.stop + self._before.size + len(ANSWER_TIMES) * len(INPUTS)
        self._products: FloatArray = np.zeros((size, size))
        self._gathered: list[tuple[Regression, FloatArray, float]] = []
        self._since_look = 0.0
        self._set_share(np.zeros(len(INPUTS)), np.zeros(len(INPUTS), dtype=bool))
        # Largest variance of what each main input answers, relative to that of the disturbances in
        # its plane, (3,), rad^2 per (rad/s^2)^2
        self.largest_answer: FloatArray = UNKNOWN_ANSWER

    def _set_share(self, share: FloatArray, sure: BoolArray) -> None:
        # R^2 of each input, (4,); 0 where it may be chance
        self.share = np.where(sure, share, 0.0)
        ratio = share / (1.0 - share)
        # q = R^2 / (1 - R^2) of each instrument's input, (rows, k), by chance or not
        self.ratio: FloatArray = ratio[self._driven_by]
        root = np.sqrt((ratio, share, self.share))[:, self._driven_by]
        # Of each pair of instruments the root of the product of q, of R^2, both by chance or not,
        # and of the significant R^2, (rows, 3, k, k); None without feedback
        answering = (root[..., :, None] * root[..., None, :]).swapaxes(0, 1)
        self.answering: FloatArray | None = answering if share.any() else None

    def add(
        self,
        samples: Regression,
        residual: FloatArray,  # (m, 3) Of the samples in the moment rows, rad/s^2
        weight: FloatArray,  # (3,) Weight of the samples in the rows, 0 ... 1
        effect: FloatArray,  # (3,) Magnitude of each row's main control derivative, 0 if not known
    ) -> None:
        """Add samples; they are evaluated every `INDEPENDENT_TIME`."""
        self._gathered.append((samples, residual, samples.dt * max(weight.tolist())))
        self._since_look += samples.time
        if self._since_look < INDEPENDENT_TIME:
            return
        self._since_look = 0.0
        gathered, self._gathered = self._gathered, []
        signals = np.empty((sum(len(own) for _, own, _ in gathered), len(self._products)))
        shares, first = np.empty((len(signals), 1)), 0
        for part, own, counted in gathered:
            if part.restarted:
                self._past = np.zeros_like(self._past)
                self._before = np.tile(part.f[0, INPUT_COLUMNS], (ORDER, 1))
            keep = np.exp(-part.dt / ANSWER_TIMES)[:, None]
            m = len(own)
            last = first + m
            inputs = np.concatenate((self._before, part.f[:, INPUT_COLUMNS]))
            self._before = inputs[-ORDER:]
            now, *lagged = inputs[_lags(m)]
            moved, past = np.hstack((own, now)), np.empty((m, *self._past.shape))
            for k in range(m):
                past[k] = self._past
                self._past = keep * self._past + moved[k]
            residuals, commands = (
                faded.reshape(m, -1) for faded in np.split(past, [len(ROWS)], axis=2)
            )
            signals[first:last] = np.hstack(
                (residuals, np.ones((m, 1)), now, own, *lagged, commands)
            )
            fade = np.exp(-counted * m / LONG_MEMORY)
            self._products *= fade
            shares[:first] *= fade
            shares[first:last] = counted
            first = last
        self._products += (shares * signals).T @ signals
        if self._products[self._answers - 1, self._answers - 1]:
            self._look(samples.dt, effect)

    def _look(self, interval: float, effect: FloatArray) -> None:
        """Update the inputs' shares of feedback, from samples `interval` s apart."""
        n = self._answers
        time = self._products[n - 1, n - 1]
        mean = self._products[n - 1] / time
        covariance = self._products / time - np.outer(mean, mean)
        matrix = covariance[: n - 1, : n - 1].copy()
        power = diagonal(matrix)
        power += ROUNDING * power + TINY
        across = covariance[: n - 1, self._inputs]
        explained = np.einsum("ji,ji->i", across, np.linalg.solve(matrix, across))
        variance = np.diag(covariance)[self._inputs]
        moved = variance > TINY
        share = np.divide(explained, variance, out=np.zeros(len(INPUTS)), where=moved)
        # By chance n regressors explain the part of n samples, +- sqrt(2 n).
        chance = (n - 1) * GUST_TIME / time
        surely = 1.0 + SURE * np.sqrt(2.0 / (n - 1))
        sure = share > chance * surely
        # Does the share move more than the gusts of its plane? No rate loop moves the throttle.
        gusts = by_plane(np.diag(covariance)[self._gusts])
        answered = (share * variance)[MAIN_PLACES]
        self.largest_answer = answered / np.maximum(gusts, ROUNDING * answered + TINY)
        stronger = np.ones(len(INPUTS), dtype=bool)
        stronger[MAIN_PLACES] = effect**2 * ((share - chance) * variance)[MAIN_PLACES] > gusts
        tested = np.flatnonzero(sure & stronger)
        predicted = [self._predicted_share(covariance, i) for i in tested.tolist()]
        sure[tested] = np.array(predicted) > (n - 1) * interval / time * surely
        self._set_share(np.maximum(share - chance, 0.0), sure)

    def _predicted_share(self, covariance: FloatArray, i: int) -> float:
        """Return the share of an input's innovation that past residuals predict.

        The innovation is the error of the prediction from the past of all inputs.
        """
        at, past = self._inputs.start + i, np.arange(self._answers - 1)
        inputs = np.arange(self._gusts.stop, len(covariance))
        new, left = (_unexplained(covariance, at, by) for by in (inputs, np.append(inputs, past)))
        return 1.0 - left / new if new > TINY else 0.0


def _unexplained(covariance: FloatArray, at: int, by: NDArray[np.intp]) -> float:
    """Return the variance of a signal that others leave unexplained."""
    matrix, across = covariance[np.ix_(by, by)], covariance[by, at]
    power = diagonal(matrix)
    power += ROUNDING * power + TINY
    return float(covariance[at, at] - across @ np.linalg.solve(matrix, across))


# --- confirmation ---------------------------------------------------------------------------------


CONFIRMED = 0.5 * SURE**2
"""Logarithm of the odds, 90 to 1, from which a derivative is confirmed: its effect is significant
at `SURE` standard deviations."""

LARGEST_ODDS = 2.0 * CONFIRMED
"""Bound on the logarithm of the odds: a failure shows soon, however long the surface had worked."""

NO_VARIANCE = float(np.finfo(float).eps)
"""Variance below which a residual counts as zero, rad^2/s^4."""

OTHER_EFFECTS = {
    (0.0, 1.0): "{row} does not follow {surface}; check the surface",
    (0.5, 1.0): "half of it explains {row} better; check the surface",
    (2.0, 1.0): "twice as much explains {row} better; check the airspeed and the load",
    (1.0, 2.0): "twice all of {row} explains the flight better; check the airspeed and the load",
}
"""Effects beside the estimated ones, relative to them, of the surface and of the whole row, and the
remark where one is more likely: a lost or reversed surface, half of one, and an aircraft that is
lighter or flies faster than assumed. The latter shows in the surface alone where it is excited, and
in the whole row where damping balances the surface. Half of a row has no entry: feedback makes all
of it look smaller."""

_LEFT = 1.0 - np.array([(1.0, 1.0), *OTHER_EFFECTS])[:, :, None, None]
"""Shares of the estimated effects, of surface and row, in the residual by each hypothesis; those of
the estimate first."""

_SIZED = _LEFT[:, 0] < 1.0
"""Hypotheses about the size of the effect, not about whether there is any."""

_OF_SIZE = np.tile(_SIZED[1:, 0, 0], 2)
"""Tests about the size of the effect: with the row's constant, then with one of its own."""


class Confirmation:
    """Evidence for and against the main control derivatives of the moment rows.

    For each derivative sequential probability ratio tests (Wald 1945) of the whitened residual:
    "the surface has its estimated effect" against each of `OTHER_EFFECTS`. A lost or reversed
    surface turns the odds as soon as it moves. A surface that does not move gives no evidence, and
    its confirmation fades. Where surfaces are excited in turns, as by doublets one after the other,
    it fades no sooner than the next turn is due.

    A surface that fails while it is deflected leaves a step, which contradicts it at once: the
    constant moment is known from before. But a surface that jams leaves no step, and goes on to
    turn the aircraft as its steady command would. And once a row is learned anew, its constant
    cancels the step. In both cases a steady deflection would confirm whatever effect is estimated.
    To be confirmed, a surface must therefore also exclude that it has no effect, and once the row
    is learned anew each other effect, with a constant of its own: by the mean of `MEMORY`.

    Where an input may answer gusts, its effect is predicted from its own past: a loop that is
    faster than the samples answers a gust within one, and this answer would count against a healthy
    surface. The regression's filter spreads a gust over two samples, which leaves a correlation of
    up to 0.6 between neighbours in the whitened residual. The size of the effect is therefore
    judged by a prediction over two samples, which is weaker; whether there is any, over one.

    With flow angles a part of the rudder's moment is by its side force, which is measured: a T37's
    rudder moves the residual of rdot less than noise does, that of ay three times as much. The
    moment, or both together, confirm the rudder. Each may contradict it: a load changes the moment
    and not the force.
    """

    def __init__(self, layout: Layout) -> None:
        self._rows, self._entries, self._moments = layout.surfaces
        self._columns = layout.index[self._rows, self._entries]
        count = len(self._rows)
        self._known_forces: BoolArray = np.zeros(count - len(ROWS), dtype=bool)
        # By the moments, by the forces, and by both together; the moment row of each
        self._tested = np.append(self._moments, range(len(ROWS)))
        # Which effects add to both together, (effects, 3)
        self._adds = 1.0 * (self._moments[:, None] == range(len(ROWS)))
        self._odds: FloatArray = np.zeros((len(_OF_SIZE), len(self._tested)))
        self._effects = Autoregression(count)
        self._innovation: FloatArray = np.zeros((count, 1))  # Last innovation of the effects
        self._now = 0.0  # Time since the start, s
        # Evidence of the last `INDEPENDENT_TIME` that the surface has an effect at all
        self._recent: FloatArray = np.zeros(len(ROWS))
        # Squared residuals of that time, times dt, by the estimated effects and by each other pair
        self._squares: FloatArray = np.zeros((len(_LEFT), count))
        # Time since the row began to learn anew, s, and the mean difference that each effect makes,
        # rad/s^2
        self._anew: FloatArray = np.full(count, np.inf)
        self._mean: FloatArray = np.zeros((len(_LEFT), count))
        self._squares_time = 0.0
        self._moved = [-math.inf] * len(ROWS)  # Last time that reached the bound, s
        # Start of each turn of the surface, and the rest before it, s
        self._turns: list[deque[tuple[float, float]]] = [deque() for _ in ROWS]

    def forget(self, row: int) -> None:
        """Clear the evidence of a row whose derivatives are learned anew."""
        self._odds[:, self._tested == row] = 0.0
        self._anew[self._moments == row] = 0.0
        self._moved[row] = -math.inf
        self._turns[row].clear()

    def forget_contradictions(self, unknown: BoolArray) -> None:
        """Clear the evidence against the size of those of `Layout.effects` that are `unknown`.

        An estimate that is not known has no size that the flight could contradict. Evidence against
        the noise of a cold start would count against the later estimate for half a minute. A force
        that is not known is no evidence at all.
        """
        self._known_forces = ~unknown[len(ROWS) :]
        forces = slice(len(ROWS), len(unknown))
        self._odds[:, forces] *= self._known_forces
        for row in np.flatnonzero(unknown[: len(ROWS)]).tolist():
            sizes = _OF_SIZE[:, None] & (self._tested == row)
            self._odds[sizes] = np.maximum(self._odds[sizes], 0.0)

    def add(
        self,
        white: RowSamples,
        coefficients: FloatArray,  # (rows, c) Of the regression problem
        variance: FloatArray,  # (rows,) Of the innovations
        max_age: float,  # Time in which a confirmation fades at rest, s; 0: never
        may_answer: BoolArray,  # (3,) Whether the main input may be feedback
        *,
        restarted: bool,  # Whether the first sample does not continue the last
    ) -> None:
        """Add whitened samples to the evidence."""
        may_answer = may_answer[self._moments]
        residual = self._residuals(white, coefficients, may_answer, restarted=restarted)
        squares = np.add.reduce(residual * residual, axis=2)
        self.fade(white.time, max_age)
        keep = math.exp(-white.time / INDEPENDENT_TIME)
        self._squares = keep * self._squares + squares[: len(_LEFT)] * white.dt
        self._squares_time = keep * self._squares_time + white.time
        # The residual of the best hypothesis is noise, too, where it exceeds the usual noise.
        least = np.minimum.reduce(self._squares) / self._squares_time
        noise = np.maximum(np.maximum(variance[self._rows], least), NO_VARIANCE)
        evidence = 0.5 * (squares[1:] - squares[0]) / noise
        # The past does not predict the rudder's slope, which the row of ay follows.
        evidence[:, len(ROWS) :] *= self._known_forces & ~may_answer[len(ROWS) :]
        together = evidence @ self._adds
        self._odds += np.hstack((evidence, together))
        self._odds = np.clip(self._odds, -LARGEST_ODDS, LARGEST_ODDS)
        recent = keep * self._recent + together[0]
        self._recent = np.clip(recent, -LARGEST_ODDS, LARGEST_ODDS)
        for i, odds in enumerate(self._recent.tolist()):
            if odds == LARGEST_ODDS:
                rested, self._moved[i] = self._now - self._moved[i], self._now
                if max_age < rested <= MEMORY:
                    self._turns[i].append((self._now, rested))

    def _residuals(
        self,
        white: RowSamples,
        coefficients: FloatArray,  # (rows, c)
        may_answer: BoolArray,  # (rows,)
        *,
        restarted: bool,
    ) -> FloatArray:
        """Return the residuals by the estimated effects and in each test, (1 + tests, rows, m)."""
        effect = coefficients[self._rows, self._columns][:, None]
        effect = effect * white.f[self._rows, :, self._entries]
        new = self._effects.whiten(effect[..., None], white.dt, restarted=restarted)[..., 0]
        before = np.hstack((self._innovation * (not restarted), new[:, :-1]))
        self._innovation = new[:, -1:]
        effect = effect - new * may_answer[:, None]
        late = self._effects.weights[:, :1] * before * may_answer[:, None]
        estimated = white.residual[self._rows]
        explained = white.y[self._rows] - estimated  # by the whole row
        explained[len(ROWS) :] = 0.0  # An inertia changes no force.
        other = _LEFT[:, 0] * (effect - _SIZED * late) + _LEFT[:, 1] * explained
        self._anew += white.time
        constant_is_known = _SIZED[..., 0] & np.isinf(self._anew)
        share = np.where(constant_is_known, 0.0, white.time / np.minimum(self._anew, MEMORY))
        self._mean += share * (other.mean(axis=2) - self._mean)
        tests = np.concatenate((other, other[1:] - self._mean[1:, :, None]))
        return np.asarray(estimated + tests)

    def fade(self, time: float, max_age: float) -> None:
        """Fade the confirmations by a time, s.

        The largest odds against no effect fade to the limit within `max_age`, s, after the next
        turn of the input is due. Those about the size of the effect fade within `MEMORY` at the
        soonest: weak excitation takes as long to tell an effect from its half.
        """
        self._now += time
        if max_age <= 0.0:
            return
        limit = CONFIRMED / LARGEST_ODDS
        ages = []
        for turns in self._turns:
            while turns and self._now - turns[0][0] > MEMORY:
                turns.popleft()
            ages.append(max_age + max((rested for _, rested in turns), default=0.0))
        effect = np.array([limit ** (time / age) for age in ages])
        size = np.array([limit ** (time / max(age, MEMORY)) for age in ages])
        self._odds[~_OF_SIZE] *= effect[self._tested]
        self._odds[_OF_SIZE] *= size[self._tested]

    def doubt(self, row: int) -> str:
        """Return why a row's main control derivative is not confirmed; empty if it is."""
        name, surface = ROWS[row], MAIN_INPUTS[ROWS[row]]
        least: list[float] = self._odds[:, self._tested == row].min(axis=1).tolist()
        remarks = OTHER_EFFECTS.values()
        for against, remark in zip(least[: len(remarks)], remarks, strict=True):
            if against <= -CONFIRMED:
                found = remark.format(row=name, surface=surface)
                return f"{name}/{surface} is contradicted: {found}"
        by_moment, together = self._odds[:, [row, row - len(ROWS)]].min(axis=0)
        if max(by_moment, together) >= CONFIRMED:
            return ""
        return (
            f"{name}/{surface} is unconfirmed: {surface} has moved too little of late to exclude "
            f"half and twice of it; move {surface}"
        )
