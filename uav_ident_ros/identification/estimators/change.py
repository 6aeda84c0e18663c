# SPDX-License-Identifier: Apache-2.0
"""Noticing that a control derivative has changed, from the residuals alone.

Forgetting cannot follow a surface that loses half its effect: fast enough for that, it lets
everything else wander. So the residuals of the last seconds are held against one change at a time:
of each control derivative, of the constant moment, and of a whole row, as by another inertia or
airspeed. With unknown noise the likelihood ratio
against "nothing changed" is (1 - E)^(-m/2) for m samples, E the share of the residual that the
change explains (generalised likelihood ratio; Basseville and Nikiforov, Detection of Abrupt
Changes, 1993). Residuals and regressors are whitened first, since gusts are slow.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.estimators.information import MODEL_ERROR, POWERLESS
from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.scales import (
    DOUBTLESS,
    GUST_TIME,
    LOOK_TIME,
    MEMORY,
    OUTLYING,
    ROUNDING,
    SURE,
)
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    INPUTS,
    MAIN_DERIVATIVES,
    ROWS,
    BoolArray,
    FloatArray,
)

WINDOW_TIME = HORIZONS[-1]
"""Time over which residuals are looked at, s: as long as a pilot's manoeuvre."""

REVERSED = 2.0
"""Change of a control derivative whose surface is reversed, relative to its value."""

PASSED = 6.0
"""Time in which a step passes the regression's filter, to 2 %, times its cut-off."""

KEPT = np.exp(-LOOK_TIME / MEMORY)
"""Share of the usual size that is kept from look to look."""


CLEARED = 0.5 * SURE
"""Standard deviations below which what seemed to change does not any more: between the two no look
is new."""


class Change(NamedTuple):
    """A coefficient that has changed."""

    row: int
    column: int | None  # None for all that moves in the row, by one share
    size: float  # Of a whole row relative to itself
    after: Regression  # The samples that lie after it, or very nearly


class ChangeDetector:
    """Watches the residuals for a changed control derivative."""

    def __init__(
        self,
        free: BoolArray,  # (3, n) Coefficients that move
        cutoff: float,  # Of the regression's filter, rad/s
    ) -> None:
        self._cutoff = cutoff
        # Throttle acts through the propeller's speed: its column has no single true value.
        surfaces = [label != "dth" for label in INPUTS]
        self._places = row, column = np.nonzero(free[:, INPUT_COLUMNS] & surfaces)
        # What may change: control derivatives, and then each row as a whole
        self._row = np.append(row, range(len(ROWS)))
        self._column = INPUT_COLUMNS.start + column
        self._surfaces = np.arange(len(self._row)) < len(column)
        # Of each the control derivatives in its row
        self._rivals = (self._row[:, None] == self._row) & self._surfaces
        self._has_constant = free[:, CONSTANT_COLUMN : CONSTANT_COLUMN + 1].any(axis=1)
        self._window: deque[Regression] = deque()
        self._time = self._since_look = 0.0
        # Of each: integral of the square of what it seemed to do, and of its input's
        self._energy = self._power = np.zeros(len(self._row))
        # Of the looks of the last `WINDOW_TIME`: energy, power, and what was known
        self._newest: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque()
        # By how much control derivatives seem to have changed where noise hides whether they have
        self.seeming: FloatArray = np.zeros((3, len(INPUTS)))
        # Usual size of each when it began to seem changed; infinite if it does not
        self._usual_before = np.full(len(self._row), np.inf)

    def restart(self) -> None:
        """Forget the window: what comes does not continue it."""
        self._window.clear()
        self._newest.clear()
        self._time = self._since_look = 0.0

    def add(self, samples: Regression) -> bool:
        """Take new samples; say whether it is time to look at them."""
        if samples.restarted:
            self.restart()
        self._window.append(samples)
        self._time += samples.time
        self._since_look += samples.time
        while self._time > WINDOW_TIME:
            self._time -= self._window.popleft().time
        if self._time < WINDOW_TIME - 1.5 * samples.time or len(self._window) < 3:
            return False  # one or two long ticks tell no slope
        return self._since_look >= LOOK_TIME - 0.5 * samples.dt

    def look(
        self,
        coefficients: FloatArray,  # (rows, c) The estimate: whitened, as the residuals are
        # (3, 4) Standard deviations of its control derivatives: what is being learned has not
        # changed. The smaller of those now and before the window count: by what a change leaves in
        # the residuals, they grow themselves.
        sigma: FloatArray,
    ) -> list[Change]:
        """Return what has changed, one coefficient a row at most.

        A motor that loses thrust steps a constant moment, and the controller answers with a step of
        its inputs, which looks like a slope. Where the step explains more, it is the constant, and
        where a row explains clearly more than any control derivative, all of it.
        """
        self._since_look = 0.0
        newest = self._window[-1]
        signals = np.concatenate([samples.signals for samples in self._window])
        window = Regression(signals, newest.rows, newest.dt)
        residual = _whitened(window.residual(coefficients)[:, :3], window.dt)
        rows = coefficients[: len(ROWS)]
        moved = np.hstack((window.f[:, self._column], window.z @ rows.T))
        regressors = _whitened(moved, window.dt)
        size, power, explained, noise = _fitted(regressors, residual[:, self._row])
        known = np.append(np.abs(rows[self._places[0], self._column]), np.ones(len(ROWS)))
        # A row is known as its main input is, and by the noise of what it makes.
        main = MAIN_DERIVATIVES
        relative = _ratio(sigma[main[0], main[1] - INPUT_COLUMNS.start], np.abs(rows[main]))
        relative[rows[main] == 0.0] = np.inf
        sigma = np.append(sigma[self._places], np.hypot(relative, noise[~self._surfaces]))
        self._newest.append((size * size * power, power, sigma))
        unsure = np.hypot(np.minimum(self._newest[0][2], sigma), MODEL_ERROR * known)
        usual = self._usual()
        # What is not known cannot be seen to change.
        sure = (np.abs(size) > SURE * np.hypot(unsure, usual)) & (known > SURE * unsure)
        # No failure changes more than a reversed surface; what a damper answers to gusts seems to.
        sure &= np.abs(size) <= REVERSED * known + SURE * unsure
        # Something is left of a whole row, and of the sign that it had.
        sure &= self._surfaces | (known + size > SURE * unsure)
        # What the residual rather owes to another input, be its effect unknown, is no change.
        left = np.maximum(1.0 - explained, ROUNDING)
        rivals = np.minimum.reduce(np.where(self._rivals & ~sure, left, 1.0), axis=1)
        owed = len(residual) * np.log(left / rivals) > OUTLYING
        # A surface that is excited alone is nearly all of its row: it has changed, not the row.
        surface = np.minimum.reduce(np.where(self._rivals, left, 1.0), axis=1)
        owed |= ~self._surfaces & (len(residual) * np.log(surface / left) <= DOUBTLESS**2)
        # The slope along an input that hardly moves tells nothing.
        informative = noise < np.hypot(unsure, usual)
        self._follow_seeming(
            np.abs(size), unsure, np.maximum(usual, noise), sure & ~owed, informative
        )
        # More than all else together: what an autopilot answers to a storm explains up to 0.4.
        explained = np.where(sure & ~owed & (explained >= 1.0 - explained), explained, 0.0)
        changes = []
        for row in sorted({*self._row[explained > 0.0].tolist()}):
            best = int(np.where(self._row == row, explained, 0.0).argmax())
            column = int(self._column[best]) if self._surfaces[best] else None
            by, first = size[best], len(signals) // 2
            share, step, passed = self._step(residual[:, row], window.dt)
            if self._has_constant[row] and share > explained[best]:
                column, by, first = CONSTANT_COLUMN, step, passed
            after = Regression(signals[first:], window.rows, window.dt)
            changes.append(Change(row, column, float(by), after))
            self.seeming[row] = 0.0
            self._usual_before[self._row == row] = np.inf
        if changes:
            self.restart()  # to the new coefficients, the change is in what came before it
        return changes

    def _follow_seeming(
        self,
        size: FloatArray,
        unsure: FloatArray,
        usual: FloatArray,
        sure: BoolArray,
        informative: BoolArray,
    ) -> None:
        """Follow by how much each seems to have changed, as far as its input `tells`.

        It does until its slope is no more than what was usual before: a change that lasts becomes
        usual itself.
        """
        sure = sure & (size > SURE * np.hypot(unsure, usual))
        before = np.minimum(self._usual_before, np.where(sure, usual, np.inf))
        still = size > CLEARED * np.hypot(unsure, before)
        self._usual_before[informative] = np.where(still, before, np.inf)[informative]
        informative, (row, column) = informative[self._surfaces], self._places
        seeming = np.where(still, size, 0.0)[self._surfaces]
        self.seeming[row[informative], column[informative]] = seeming[informative]

    def _usual(self) -> FloatArray:
        """Return the usual size of what seems to change, rms: model errors come and go.

        Each look counts by the power of its input, since the slope along one that hardly moves is
        noise. The newest window does not count yet: a change would become usual itself.
        """
        if len(self._newest) > WINDOW_TIME / LOOK_TIME:
            energy, power, _ = self._newest.popleft()
            self._energy = KEPT * self._energy + energy
            self._power = KEPT * self._power + power
        return np.sqrt(_ratio(self._energy, self._power))

    def _step(self, residual: FloatArray, dt: float) -> tuple[float, float, int]:
        """Return share explained and size of the constant's step that explains most, and its end.

        That is the sample at which it has passed the filter, the last at the latest. Column k is
        a step at the start of sample k + 1, as the filter passes it, at the middle of each sample.
        """
        count = len(residual) + 1
        since = np.maximum(np.arange(count)[:, None] - np.arange(1, count) + 0.5, 0.0)
        phase = self._cutoff * dt * since / np.sqrt(2.0)
        steps = 1.0 - np.exp(-phase) * (np.cos(phase) + np.sin(phase))
        size, _, explained, _ = _fitted(_whitened(steps, dt), residual[:, None])
        best = int(explained.argmax())
        passed = best + 1 + round(PASSED / (self._cutoff * dt))
        return float(explained[best]), float(size[best]), min(passed, count - 1)


def _whitened(signals: FloatArray, dt: float) -> FloatArray:
    """Return signals (m, k) less what the sample `dt` s before lets expect, (m - 1, k)."""
    return np.asarray(signals[1:] - np.exp(-dt / GUST_TIME) * signals[:-1])


def _fitted(regressors: FloatArray, residual: FloatArray) -> tuple[FloatArray, ...]:
    """Return slope, power of the regressor, share explained, and standard error of the slope.

    Residuals each by its own regressor, (m, k).
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
