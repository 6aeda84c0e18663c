# SPDX-License-Identifier: Apache-2.0
"""Recursive regression: least squares, or the instrumental variable, with its guards.

Gyro noise and gusts are in the regressors and bias least squares. The regressors of the
model's own state are not correlated with them, which makes them instruments (Young 2011,
SRIVC; here in information form, for a nonlinear model, and with guards since the model runs
while its coefficients are still poor).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.estimators.change import (
    LIVELY_SHARE,
    WINDOW_TIME,
    ChangeDetector,
)
from uav_ident_ros.identification.estimators.excitation import ExcitationGate
from uav_ident_ros.identification.estimators.information import Information, Snapshot
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.settings import LARGEST_COEFFICIENT, Settings
from uav_ident_ros.identification.structure import INPUT_COLUMNS, BoolArray, FloatArray

WARM_UP_TIME = 10.0
"""Time for which least squares builds the first model, s."""

FADE_TIME = 8.0
"""Time constant with which the information of the least-squares start then fades, s. It is
biased, so it must go; at once, too little would be left where a flight has told little yet."""

FADE_STEP = 0.5
"""Time between two steps of that fading, s."""

FADED_SHARE = 1e-12
"""Share of the start below which nothing is left to fade."""

SNAPSHOT_TIME = 0.5
"""Time between the copies of the information that a change goes back to, s."""

READD_TIME = 2.5
"""Newest stretch that lies after a noticed change, s, or very nearly."""

SLOPE_SHARE = 0.1
"""Share of the information behind the slope of a change that counts beside that stretch: most of
it is in there already, and some may be from before the change."""

SLOPE_ERROR = 0.15
"""Relative error of that slope, for the same reason."""

TRIAL_TIME = 10.0
"""Time in which a release has to prove itself, s."""

TRIAL_RATIO = 0.8
"""Squared residual of the new coefficients, relative to the old ones', above which a release
is taken back: a real change leaves the old ones far behind, a false alarm does not."""


@dataclass
class Trial:
    """A release on trial.

    Parameters
    ----------
    before : Snapshot
        The information as it would be without the release.
    old : (n,) array
        The row's coefficients before the release.
    """

    before: Snapshot
    old: FloatArray
    old_error: float = 0.0
    new_error: float = 0.0
    time: float = 0.0


class InstrumentalVariable:
    """Information with instruments, after a least-squares start that fades.

    Parameters
    ----------
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    forgetting_time : float
        Time constant of forgetting, s; 0 for never.

    Attributes
    ----------
    warming_up : bool
        Whether the regressors are still their own instruments.
    """

    def __init__(self, start: Start, forgetting_time: float) -> None:
        self.information = Information(start, forgetting_time)
        self.warming_up = True
        self._fading: Snapshot | None = None
        self._start_share: FloatArray = np.ones(3)
        self._since_fade: FloatArray = np.zeros(3)

    def accumulate(
        self,
        data: Regression,
        residual: FloatArray,
        weight: FloatArray,
        quiet: BoolArray | None = None,
    ) -> None:
        """Add the samples of a tick; parameters as in `Information.accumulate`."""
        if self.warming_up and self.information.time.max() >= WARM_UP_TIME:
            self.warming_up = False
            self._fading = self.information.snapshot()
        if self._fading is not None:
            self._since_fade += (weight > 0.0) * data.time
            if self._since_fade.max() >= FADE_STEP:
                self._fading = self._fade(self._fading)
        z = data.f if self.warming_up else data.z
        self.information.accumulate(data, z, residual, weight, quiet)

    def _fade(self, start: Snapshot) -> Snapshot | None:
        """Fade the least-squares start a step further; return what is left of it."""
        spent, self._since_fade = self._since_fade, np.zeros(3)
        keep = np.exp(-spent / FADE_TIME)
        left = self.information.fade(start, keep)
        self._start_share *= keep
        if self._start_share.max() < FADED_SHARE:
            return None
        forgetting_time = self.information.forgetting_time
        return left.scaled(np.exp(-spent / forgetting_time)) if forgetting_time > 0.0 else left

    def discount(self, weight: float) -> None:
        """Let all that was accumulated count for `weight` of what it did."""
        self.information.discount(weight)
        if self._fading is not None:
            self._fading = self._fading.scaled(np.full(3, weight))


class RecursiveRegression:
    """Least squares or instrumental variable, in one pass.

    Rows pause in quiet flight, and a control derivative that changes is released alone.

    Parameters
    ----------
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    settings : Settings
        Time constant of forgetting, and the excitation that a row needs.
    instrumental : bool
        Whether the instrumental variable gives the coefficients. If not, it only tells how
        far least squares is biased.

    Attributes
    ----------
    learning : (3,) bool array
        Rows that learned at the last tick.
    changes : list of (row, column)
        Coefficients released at the last tick.
    information : Information
        What the flight has told, least squares or instrumental variable.
    """

    def __init__(self, start: Start, settings: Settings, *, instrumental: bool) -> None:
        forgetting_time = settings.forgetting_time
        self.coefficients: FloatArray = start.values.copy()
        self.problem = ""
        self.learning: BoolArray = np.ones(3, dtype=bool)
        self.changes: list[tuple[int, int]] = []
        self._start = start
        self._instrumental = instrumental
        self._reference = InstrumentalVariable(start, forgetting_time)
        self.information = (
            self._reference.information if instrumental else Information(start, forgetting_time)
        )
        self._gate = ExcitationGate(start.free, settings.supervision)
        self._detector = ChangeDetector(start.free)
        self._snapshots: deque[Snapshot] = deque(maxlen=round(WINDOW_TIME / SNAPSHOT_TIME))
        self._trials: dict[int, Trial] = {}
        self._since_snapshot = 0.0

    @property
    def clear(self) -> BoolArray:
        """Rows in which the inputs stand out from all else that moves the aircraft."""
        return self._gate.clear

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (3, n); 0 where a coefficient is not free.

        Those of least squares are widened by its distance from the instrumental variable:
        its bias in gusts is many times what its own residuals tell.
        """
        sigma = self.information.sigma
        if self._instrumental:
            return sigma
        distance = self.coefficients - self._reference.information.solve()
        return np.where(self._start.free, np.hypot(sigma, distance), 0.0)

    def update(self, data: Regression, residual: FloatArray, weight: FloatArray) -> None:
        """Add the samples of a tick and solve."""
        seen = self._gate.update(data, residual, self.coefficients, self.information.sigma)
        weight = weight * seen
        self.learning = weight > 0.0
        self._reference.accumulate(data, residual, weight, self._gate.quiet)
        if not self._instrumental:
            self.information.accumulate(data, data.f, residual, weight, self._gate.quiet)
        self._follow_changes(data)
        self._accept(self.information.solve())

    def _accept(self, solution: FloatArray) -> None:
        """Take a solution row by row; a row that makes no sense starts anew where it stood."""
        sane = (np.abs(solution) < LARGEST_COEFFICIENT).all(axis=1)  # NaN fails too
        if not sane.all():
            solution = np.where(sane[:, None], solution, self.coefficients)
            self.information.discount(sane * 1.0)
        self.coefficients = solution

    def reconfigure(self, settings: Settings) -> None:
        """Take over the settings that may change in flight."""
        self._reference.information.forgetting_time = settings.forgetting_time
        self.information.forgetting_time = settings.forgetting_time
        self._gate.settings = settings.supervision

    def forget(self, weight: float) -> None:
        """Let all that was learned so far count for `weight` of what it did."""
        self._reference.discount(weight)
        if not self._instrumental:
            self.information.discount(weight)
        self._detector = ChangeDetector(self._start.free)
        self._snapshots.clear()
        self._trials.clear()

    def _follow_changes(self, data: Regression) -> None:
        """Release what has changed, and take back a release that does not prove itself."""
        for row in list(self._trials):
            self._continue_trial(row, data)
        lively = self._gate.share >= LIVELY_SHARE
        changed = self._detector.update(data, self.coefficients, lively, self.clear)
        self.changes = [(i, INPUT_COLUMNS.start + j) for i, j in changed]
        for i, j in changed:
            self._release(i, j)
        self._since_snapshot += data.time
        if self._since_snapshot >= SNAPSHOT_TIME:
            self._snapshots.append(self.information.snapshot())
            self._since_snapshot = 0.0

    def _release(self, row: int, j: int) -> None:
        """Forget what input `j` did in one row, back to before the change, and learn it anew."""
        found, column = self._detector.found, INPUT_COLUMNS.start + j
        shift = float(found.slope[row, j])
        self._trials[row] = Trial(self.information.snapshot(), self.coefficients[row].copy())
        if self._snapshots:
            self.information.restore(row, self._snapshots[0])
        sigma = max(float(found.deviation[row, j]), SLOPE_ERROR * abs(shift))
        power = SLOPE_SHARE * float(found.power[j])
        self.information.release(row, column, shift, sigma, power)
        time = 0.0
        for tick in reversed(self._detector.recent):
            time += tick.dt
            if time > READD_TIME:
                break
            z = tick.z if self._instrumental and not self._reference.warming_up else tick.f
            self.information.add_sample(row, tick.y, tick.f, z, tick.dt)

    def _continue_trial(self, row: int, data: Regression) -> None:
        """Compare the old with the new coefficients on samples that neither has seen."""
        trial = self._trials[row]
        trial.before.matrix[row] += self.information.added[0][row]
        trial.before.vector[row] += self.information.added[1][row]
        y = data.y[:, row]
        trial.old_error += float(np.sum((y - data.f @ trial.old) ** 2))
        trial.new_error += float(np.sum((y - data.f @ self.coefficients[row]) ** 2))
        trial.time += data.time
        if trial.time >= TRIAL_TIME:
            del self._trials[row]
            if trial.new_error > TRIAL_RATIO * trial.old_error:
                self.information.restore(row, trial.before)
