# SPDX-License-Identifier: Apache-2.0
"""Detection of changed control derivatives from the residuals.

Forgetting cannot follow a surface that loses half its effect: fast enough for that, it lets all
other coefficients wander. The residuals of the last seconds are therefore tested for one change at
a time: of each control derivative, of the constant moment, and of a whole row, as by another
inertia or airspeed. With unknown noise the likelihood ratio against "nothing changed" is
(1-E)^(-m/2) for m samples. E is the share of the residual that the change explains (generalised
likelihood ratio; Basseville and Nikiforov, Detection of Abrupt Changes, 1993). Residuals and
regressors are whitened first, since gusts are slow. A detected change has the size and the time
that explain most.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.estimators.information import MODEL_ERROR, POWERLESS
from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.regression import Layout, Regression
from uav_ident_ros.identification.residuals import by_plane
from uav_ident_ros.identification.scales import (
    DOUBTLESS,
    GUST_TIME,
    LOOK_TIME,
    MEMORY,
    OUTLYING,
    ROUNDING,
    SURE,
    TINY,
)
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    INPUTS,
    MAIN_COLUMNS,
    MAIN_DERIVATIVES,
    ROWS,
    BoolArray,
    FloatArray,
)

WINDOW_TIME = HORIZONS[-1]
"""Window of the tested residuals, s: as long as a pilot's manoeuvre."""

REVERSED = 2.0
"""Change of a reversed surface's control derivative, relative to its value."""

PASSED = 6.0
"""Settling time of the regression's filter after a step, to 2 %, times its cut-off."""

KEPT = np.exp(-LOOK_TIME / MEMORY)
"""Discount factor of the usual slope from one test to the next."""


class Change(NamedTuple):
    """A detected change of a coefficient."""

    row: int
    column: int | None  # None for the whole row, scaled by one factor
    size: float  # Of the coefficient; of a whole row relative to its value
    after: Regression  # Samples after the change, very nearly


class Candidates:
    """What may change: control derivatives, the rudder's side force, and each row as a whole.

    Each array has an entry for each of them; those of the problem have none for whole rows.
    """

    def __init__(self, free: BoolArray, layout: Layout) -> None:
        # Throttle acts through the propeller's speed: its derivative has no single true value.
        surfaces = [label != "dth" for label in INPUTS]
        own, column = np.nonzero(free[: len(ROWS), INPUT_COLUMNS] & surfaces)
        column += INPUT_COLUMNS.start
        force, entry, moment = layout.surfaces[:, len(ROWS) :]
        whole = np.arange(len(ROWS))
        self.row = np.concatenate((own, moment, whole))  # The moment row that changes
        self.shown_by = np.concatenate((own, force, whole))  # Row of the problem that shows it
        self.is_surface = np.arange(len(self.row)) < len(own) + len(moment)
        # Place of the regressor in the problem, and of the derivative in the structure
        self.regressor = np.append(own, force), np.append(column, layout.index[force, entry])
        self.place = np.append(own, force), np.append(column, MAIN_COLUMNS[moment])
        # Whether it is the effect of the row's main input
        self.is_main = self.is_surface.copy()
        self.is_main[: len(own)] = column == MAIN_COLUMNS[own]
        # Of each candidate the surfaces in the row that shows it, (candidates, candidates)
        self.rivals = (self.shown_by[:, None] == self.shown_by) & self.is_surface


class ChangeDetector:
    """Detector of changes of a row's coefficients, one at a time."""

    def __init__(
        self,
        free: BoolArray,  # (R, n) Coefficients that are estimated
        layout: Layout,
        cutoff: float,  # Of the regression's filter, rad/s
    ) -> None:
        self._cutoff = cutoff
        self._candidates = Candidates(free, layout)
        self._has_constant = free[: len(ROWS), CONSTANT_COLUMN : CONSTANT_COLUMN + 1].any(axis=1)
        self._window: deque[Regression] = deque()
        self._time = self._since_look = 0.0
        # Of each candidate: discounted sums of squared slope times power, and of its input's power
        self._energy = self._power = np.zeros(len(self._candidates.row))
        # Of the tests in the last `WINDOW_TIME`: energy, power, standard deviations
        self._newest: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque()
        self._wait: FloatArray = np.zeros(len(ROWS))  # Until the window follows the last change, s

    def restart(self) -> None:
        """Clear the window, since the next samples do not continue it."""
        self._window.clear()
        self._newest.clear()
        self._time = self._since_look = 0.0
        self._wait = np.zeros(len(ROWS))

    def add(self, samples: Regression) -> bool:
        """Add samples; return whether a test is due."""
        if samples.restarted:
            self.restart()
        self._window.append(samples)
        self._time += samples.time
        self._since_look += samples.time
        self._wait -= samples.time
        while self._time > WINDOW_TIME:
            self._time -= self._window.popleft().time
        if self._time < WINDOW_TIME - 1.5 * samples.time or len(self._window) < 3:
            return False  # one or two long ticks determine no slope
        return self._since_look >= LOOK_TIME - 0.5 * samples.dt

    def look(
        self,
        coefficients: FloatArray,  # (rows, c) The whitened estimate, as the residuals are
        # (R, n) Published standard deviations: a slope within them is learning, no change. The
        # smaller of those now and before the window counts: a change increases the present ones.
        sigma: FloatArray,
        # (3,) Rows whose residual is far outside its usual size, and that therefore learn little
        outlying: BoolArray,
        # (3,) Error of each row's main control derivative, relative to it; 1 if not known
        model_error: FloatArray,
        answers: FloatArray,  # (3,) `Feedback.largest_answer`
    ) -> list[Change]:
        """Return the detected changes, at most one in each row.

        A motor that loses thrust steps a constant moment. The controller's answer is a step of its
        inputs, which resembles a slope. Where the step explains clearly more, the constant has
        changed: a surface that is held, as in a 3-2-1-1, makes steps as well.
        It has also changed where its mean is all that is unusual in an outlying residual.
        Where a whole row explains clearly more than each control derivative, the row has changed.

        A rudder changes its moment and its side force alike, and the row that shows more of it is
        taken. With flow angles the moment by its side force is in the measured force already, and
        what is left may be less than the noise.

        A change explains more than all else together, since an autopilot's answers to a storm
        explain up to 0.4. An input of which a share S answers disturbances explains at most S of
        them (Cauchy and Schwarz). Of a main control derivative any doubtless excess is enough, if
        the change is also doubtless beside sigma, the usual slope and the model error.
        """
        self._since_look = 0.0
        newest = self._window[-1]
        signals = np.concatenate([samples.signals for samples in self._window])
        window = Regression(signals, newest.rows, newest.dt)
        left_over = window.residual(coefficients)
        residual = _whitened(left_over, window.dt)
        rows, candidates = coefficients[: len(ROWS)], self._candidates
        moved = np.hstack((window.f[:, candidates.regressor[1]], window.z @ rows.T))
        regressors = _whitened(moved, window.dt)
        size, power, explained, noise = _fitted(regressors, residual[:, candidates.shown_by])
        known, sigma = self._known(coefficients, sigma, noise)
        follows = self._wait <= 0.0
        power = np.where(follows[candidates.row], power, 0.0)
        self._newest.append((size * size * power, power, sigma))
        unsure = np.hypot(np.minimum(self._newest[0][2], sigma), MODEL_ERROR * known)
        error = np.hypot(unsure, self._usual())
        # A change needs a derivative that was known before.
        sure = (np.abs(size) > SURE * error) & (known > SURE * unsure) & follows[candidates.row]
        # No failure exceeds a reversed surface; a damper's answers to gusts appear to.
        sure &= np.abs(size) <= REVERSED * known + SURE * unsure
        # A whole row keeps its sign and a part of its moment.
        sure &= candidates.is_surface | (known + size > SURE * unsure)
        left = np.maximum(1.0 - explained, ROUNDING)
        share = self._answering(answers, window, left_over)[candidates.row]
        beyond = candidates.is_main & (left * np.exp(DOUBTLESS**2 / len(residual)) < 1.0 - share)
        error = np.hypot(error, model_error[candidates.row] * known)
        clear = (explained >= left) | beyond & (np.abs(size) > DOUBTLESS * error)
        clear &= sure & ~self._is_rivalled(left, sure, len(residual))
        changes = []
        for row in sorted({*candidates.row[clear].tolist()}):
            best = int(np.where(clear & (candidates.row == row), explained, 0.0).argmax())
            change = self._change(best, coefficients, window, regressors[:, best], residual)
            changes += [change] if change else []
        explained_rows = [change.row for change in changes]
        others = outlying & self._has_constant & follows
        others[explained_rows] = False
        changes += self._shifted(window, left_over, others)
        self._begin_anew([change.row for change in changes])
        return changes

    def _change(
        self,
        best: int,  # Of the candidates
        coefficients: FloatArray,
        window: Regression,
        regressor: FloatArray,  # (m - 1,) Of that candidate, whitened
        residual: FloatArray,  # (m - 1, rows) Whitened
    ) -> Change | None:
        """Return the change of a candidate, or of the constant; None if the force has stepped."""
        candidates = self._candidates
        row, shown_by = (int(rows[best]) for rows in (candidates.row, candidates.shown_by))
        size, first, left_by_slope = _since(regressor, residual[:, shown_by])
        column: int | None = None
        if candidates.is_surface[best]:
            column = int(candidates.place[1][best])
            # The same share of its moment is lost as of its force.
            effect = coefficients[shown_by, candidates.regressor[1][best]]
            size *= coefficients[row, column] / effect
        step, passed, left_by_step = self._step(residual[:, shown_by], window.dt)
        beaten = len(residual) * np.log(left_by_slope / left_by_step)
        if self._has_constant[row] and beaten > DOUBTLESS**2:
            if shown_by != row:
                return None
            column, size, first = CONSTANT_COLUMN, step, passed
        after = Regression(window.signals[first:], window.rows, window.dt)
        return Change(row, column, size, after)

    def _known(
        self, coefficients: FloatArray, sigma: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return magnitude and standard deviation of each candidate; of whole rows relative ones.

        A row's sigma has two parts: its main derivative's, and that of its factor by the noise.
        """
        main = coefficients[MAIN_DERIVATIVES]
        relative = _ratio(sigma[MAIN_DERIVATIVES], np.abs(main))
        relative[main == 0.0] = np.inf
        known = np.abs(coefficients[self._candidates.regressor])
        of_rows = np.hypot(relative, noise[~self._candidates.is_surface])
        sigma = np.append(sigma[self._candidates.place], of_rows)
        return np.append(known, np.ones(len(ROWS))), sigma

    def _is_rivalled(self, left: FloatArray, sure: BoolArray, count: int) -> BoolArray:
        """Return which changes another candidate explains better.

        A residual that another input explains better, even one of unknown effect, is no change. A
        surface excited alone makes nearly all of its row: it has changed, not the row.
        """
        beside, is_surface = self._candidates.rivals, self._candidates.is_surface
        rivals = np.minimum.reduce(np.where(beside & ~sure, left, 1.0), axis=1)
        surface = np.minimum.reduce(np.where(beside, left, 1.0), axis=1)
        row_beaten = ~is_surface & (count * np.log(surface / left) <= DOUBTLESS**2)
        return np.asarray((count * np.log(left / rivals) > OUTLYING) | row_beaten)

    def _answering(
        self, answers: FloatArray, window: Regression, residual: FloatArray
    ) -> FloatArray:
        """Return the largest share of each main input's motion that answers disturbances, (3,)."""
        answered = answers * by_plane(np.add.reduce(residual * residual) / len(residual))
        moved = window.f[:, MAIN_COLUMNS].var(axis=0)
        return np.asarray(answered / np.maximum(moved, np.maximum(answered, TINY)))

    def _begin_anew(self, rows: list[int]) -> None:
        """Leave rows out until the window contains no more of their change."""
        self._wait[rows] = self._time
        own = np.isin(self._candidates.row, rows)
        for energy, power, sigma in self._newest:
            energy[own] = power[own] = 0.0
            sigma[own] = np.inf

    def _usual(self) -> FloatArray:
        """Return the usual slope of each candidate, rms: model errors come and go.

        Each test is weighted by the power of its input, since the slope along a resting input is
        noise. The newest window is excluded: a change would become usual itself.
        """
        if len(self._newest) > WINDOW_TIME / LOOK_TIME:
            energy, power, _ = self._newest.popleft()
            self._energy = KEPT * self._energy + energy
            self._power = KEPT * self._power + power
        return np.sqrt(_ratio(self._energy, self._power))

    def _shifted(self, window: Regression, residual: FloatArray, rows: BoolArray) -> list[Change]:
        """Return the changes of the constant in those of the rows that it explains.

        Flaps, a gear or a dropped load change the trim, at once or over seconds. No input explains
        that, and a row whose residual is too large to learn from does not learn it, either.
        """
        changes = []
        for row in np.flatnonzero(rows).tolist():
            own = residual[:, row]
            mean, square = np.add.reduce(own) / len(own), np.add.reduce(own * own) / len(own)
            if OUTLYING * (square - mean * mean) <= square:  # the rest is of usual size
                size = float(mean / np.mean(window.f[:, CONSTANT_COLUMN]))
                after = Regression(window.signals[len(own) // 2 :], window.rows, window.dt)
                changes.append(Change(row, CONSTANT_COLUMN, size, after))
        return changes

    def _step(self, residual: FloatArray, dt: float) -> tuple[float, int, float]:
        """Return the best step of the constant: size, end, and share that it leaves unexplained.

        The end is the sample at which the step has passed the filter, at most the last. Column k is
        a step at the start of sample k + 1 after the filter, at the middle of each sample.
        """
        count = len(residual) + 1
        since = np.maximum(np.arange(count)[:, None] - np.arange(1, count) + 0.5, 0.0)
        phase = self._cutoff * dt * since / np.sqrt(2.0)
        steps = 1.0 - np.exp(-phase) * (np.cos(phase) + np.sin(phase))
        size, _, explained, _ = _fitted(_whitened(steps, dt), residual[:, None])
        best = int(explained.argmax())
        passed = best + 1 + round(PASSED / (self._cutoff * dt))
        left = max(1.0 - float(explained[best]), ROUNDING)
        return float(size[best]), min(passed, count - 1), left


def _since(regressor: FloatArray, residual: FloatArray) -> tuple[float, int, float]:
    """Return the slope of a residual since its most likely start: size, start, and share left."""
    u, e = regressor - regressor.mean(), residual - residual.mean()
    power, product = np.cumsum((u * u)[::-1])[::-1], np.cumsum((u * e)[::-1])[::-1]
    slope = _ratio(product, power)
    first = int((slope * product).argmax())
    left = max(1.0 - slope[first] * product[first] / (e @ e), ROUNDING)
    return float(slope[first]), first, float(left)


def _whitened(signals: FloatArray, dt: float) -> FloatArray:
    """Return first-order prewhitened signals, (m, k) to (m - 1, k), of samples `dt` s apart."""
    return np.asarray(signals[1:] - np.exp(-dt / GUST_TIME) * signals[:-1])


def _fitted(regressors: FloatArray, residual: FloatArray) -> tuple[FloatArray, ...]:
    """Return slope, power of the regressor, share explained, and standard error of the slope.

    Each column of the residuals, (m, k), is fitted by its own regressor.
    """
    u = regressors - np.add.reduce(regressors) / len(regressors)
    e = residual - np.add.reduce(residual) / len(residual)
    power, product = np.add.reduce(u * u), np.add.reduce(u * e)
    power[power < POWERLESS] = 0.0  # a constant input has no slope
    slope, energy = _ratio(product, power), np.add.reduce(e * e)
    left = np.maximum(energy - slope * product, 0.0)
    error = np.sqrt(
        np.divide(left / len(e), power, out=np.full_like(left, np.inf), where=power > 0)
    )
    return slope, power, _ratio(slope * product, energy), error


def _ratio(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a / b, zero where b is not positive."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0.0)
