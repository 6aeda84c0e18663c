# SPDX-License-Identifier: Apache-2.0
"""Recursive regression: least squares, or the instrumental variable, with its guards.

Gyro noise and gusts are in the regressors and bias least squares. The regressors of the
model's own state are not correlated with them, which makes them instruments (Young 2011,
SRIVC; here in information form, for a nonlinear model, and with guards since the model runs
while its coefficients are still poor).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.estimators.change import (
    CONSTANT,
    LIVELY_SHARE,
    WINDOW_TIME,
    ChangeDetector,
)
from uav_ident_ros.identification.estimators.excitation import ExcitationGate
from uav_ident_ros.identification.estimators.information import (
    MODEL_ERROR,
    Information,
    Solution,
    Sums,
)
from uav_ident_ros.identification.estimators.model_error import ModelError
from uav_ident_ros.identification.feedback import Feedback
from uav_ident_ros.identification.prior import Start, slope_bounds, weak_sigma
from uav_ident_ros.identification.regression import Layout, Regression, layout
from uav_ident_ros.identification.row_samples import RowSamples
from uav_ident_ros.identification.settings import LARGEST_COEFFICIENT, Settings
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    INPUTS,
    MAIN_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    STRUCTURES,
    BoolArray,
    FloatArray,
)

WARM_UP_TIME = 10.0
"""Time for which least squares builds the first model, s."""

FADE_TIME = 8.0
"""Time constant with which the information of the least-squares start then fades, s. It is
biased, so it must go; at once, too little would be left where a flight has told little yet."""

SNAPSHOT_TIME = 0.5
"""Time between the copies of the information that a change goes back to, s."""

WHITENED_TIME = 0.25
"""Time between two solutions of the whitened estimate, s: sigma needs no more."""

POWER_TIME = 10.0
"""Memory of the mean square of the rates, s."""

LARGEST_LEVERAGE = 9.0
"""Square of a rate that the model answers to what is injected, relative to the mean square of those
measured, up to which its samples count in full: three sigma."""

READD_TIME = 2.5
"""Newest stretch that lies after a noticed change, s, or very nearly."""

SLOPE_ERROR = 0.5
"""Relative error of the slope by which a change shows: its window straddles the change."""

TRIAL_TIME = 10.0
"""Time in which a covariance reset has to prove itself, s."""

TRIAL_RATIO = 0.8
"""Squared residual of the new coefficients, relative to the old ones', above which a reset
is taken back: a real change leaves the old ones far behind, a false alarm does not."""


@dataclass
class Trial:
    """A covariance reset on trial.

    Parameters
    ----------
    before : Sums
        The information as it would be without the reset.
    old : (k,) array
        The row's coefficients before the reset.
    beside : list of Sums
        The information of the estimates that run beside, before the reset.
    """

    before: Sums
    old: FloatArray
    beside: list[Sums]
    old_error: float = 0.0
    new_error: float = 0.0
    time: float = 0.0


class InstrumentalVariable:
    """Information with instruments, after a least-squares start that fades.

    Parameters
    ----------
    information : Information
        Where to accumulate.

    Attributes
    ----------
    information : Information
        The parameter.
    warming_up : bool
        Whether the regressors are still their own instruments.
    """

    def __init__(self, information: Information) -> None:
        self.information = information
        self.warming_up = True
        self._start: Sums | None = None

    def add(self, samples: RowSamples, weight: FloatArray, ratio: FloatArray | None = None) -> None:
        """Add samples; parameters as in `Sums.add`."""
        information = self.information
        if self.warming_up and information.time.max() >= WARM_UP_TIME:
            self.warming_up = False
            self._start, information.sums = information.sums, information.sums.nothing_alike()
        if self._start is not None:
            self._start.weigh(np.exp(-weight * samples.time / FADE_TIME))
        information.add(samples.uninstrumented() if self.warming_up else samples, weight, ratio)

    @property
    def sums(self) -> Sums:
        """All that is known."""
        sums = self.information.sums
        return sums if self._start is None else sums.plus(self._start)

    def solve(self, values: FloatArray) -> Solution:
        """Return the solution; `values` (R, n) are the coefficients before."""
        return self.information.solve(values, self._start)

    def discount(self, keep: float) -> None:
        """Let all that was accumulated be worth `keep` of what it was."""
        self.information.discount(keep)
        if self._start is not None:
            self._start.discount(np.full(len(self._start.blocks), keep))

    def set_row(self, row: int, sums: Sums) -> None:
        """Replace what is known in one row."""
        self.information.sums.set_row(row, sums)
        if self._start is not None:
            self._start.set_row(row, self._start.nothing_alike())


class RecursiveRegression:
    """Least squares or instrumental variable, in one pass.

    Rows pause in quiet flight, and a control derivative that changes is released alone. Beside it
    runs the same estimate with the residuals whitened: where an autopilot answers gusts, and
    nothing else moves its surfaces, the plain estimate is the autopilot's, the whitened one less
    so; with excitation they agree. Sigma covers their distance.

    Parameters
    ----------
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    settings : Settings
        Structure, time constant of forgetting, and the excitation that a row needs.
    instrumental : bool
        Whether the instrumental variable gives the coefficients. If not, it only tells how
        far least squares is biased.

    Attributes
    ----------
    coefficients, sigma : (R, n) array
        Estimate and standard deviations; 0 where a coefficient is not free. Those of least squares
        are widened by its distance from the instrumental variable: its bias in gusts is many
        times what its own residuals tell.
    learning : (3,) bool array
        Moment rows that learned at the last update.
    changes : list of (row, column)
        Coefficients released at the last update.
    information : Information
        What the flight has told, least squares or instrumental variable.
    """

    def __init__(self, start: Start, settings: Settings, *, instrumental: bool) -> None:
        self._structure = STRUCTURES[settings.structure]
        self._layout = layout(self._structure)
        self._bounds = slope_bounds(self._structure)
        self._error = ModelError(self._layout)
        inputs_told = start.told(self._structure)[: len(ROWS), INPUT_COLUMNS]
        self._told = inputs_told.any(axis=1, keepdims=True)
        self._feedback = Feedback()
        self._power: FloatArray = np.zeros(len(ROWS))  # mean square of the rates
        self._injected = False
        self._driven_by = _driven_by(self._layout)
        self._used_rows = np.nonzero(self._layout.used)[0]
        self._used_columns = self._layout.index[self._layout.used]
        self._start = start
        self.problem = ""
        self.learning = np.ones(3, dtype=bool)
        self.changes: list[tuple[int, int]] = []

        def information() -> Information:
            correlation_time = 2.0 / settings.filter.cutoff
            return Information(
                self._structure, self._layout, start, correlation_time, settings.forgetting_time
            )

        self._reference = InstrumentalVariable(information())
        self._least_squares = None if instrumental else information()
        self._whitened = InstrumentalVariable(information())
        self.information = self._least_squares or self._reference.information
        self.coefficients: FloatArray = start.values.copy()
        self.sigma: FloatArray = start.sigma.copy()
        self._white = self._whitened.solve(self.coefficients)
        self._solution = self._solve()
        self._gate = ExcitationGate(start.free[:3], settings.supervision)
        self._cutoff = settings.filter.cutoff
        self._detector = ChangeDetector(start.free[:3], self._cutoff)
        self._recent: deque[RowSamples] = deque()
        self._snapshots: deque[Solution] = deque(maxlen=round(WINDOW_TIME / SNAPSHOT_TIME))
        self._trials: dict[int, Trial] = {}
        self._since_snapshot = self._since_white = 0.0

    @property
    def start(self) -> Start:
        """Initial coefficients, their uncertainty, and which are free."""
        return self._start

    @start.setter
    def start(self, start: Start) -> None:
        self._start = start
        for information in (
            self._reference.information,
            self._whitened.information,
            self.information,
        ):
            information.start = start
        self.coefficients = np.where(start.free, self.coefficients, start.values)
        self.sigma = np.where(start.free, self.sigma, start.sigma)

    @property
    def clear(self) -> BoolArray:
        """Moment rows in which the inputs stand out from all else that moves the aircraft."""
        return self._gate.clear

    @property
    def model_error(self) -> FloatArray:
        """What the main inputs do otherwise than the model says, relative to their effect, (3,)."""
        return self._error.share

    @property
    def answers(self) -> FloatArray:
        """Share of each input that answers disturbances, shape (4,), 0 ... 1."""
        return self._feedback.share

    @property
    def inputs(self) -> FloatArray:
        """Control derivatives that go with the residuals, shape (3, 4): with measured forces."""
        return self._linear(self._solution)[: len(ROWS), INPUT_COLUMNS]

    def _linear(self, solution: Solution) -> FloatArray:
        """Coefficients of the linear problem in the place of their columns, shape (rows, c)."""
        linear = np.zeros((self._layout.rows, self._layout.size))
        linear[self._used_rows, self._used_columns] = solution.linear[self._layout.used]
        return linear

    def residual(self, samples: Regression) -> FloatArray:
        """Return ``y - A f`` of samples, shape (m, rows)."""
        return samples.residual(self._linear(self._solution))

    def update(
        self, samples: Regression, residual: FloatArray, white: RowSamples, weight: FloatArray
    ) -> None:
        """Add samples and solve."""
        moments = residual[:, : len(ROWS)]
        seen = self._gate.update(samples, moments, self.coefficients[: len(ROWS)])
        self.learning = self._gate.learning & (weight > 0.0)
        weight = weight * seen
        square = np.add.reduce(np.square(samples.f[:, RATE_COLUMNS])) / len(samples.f)
        self._power += min(samples.time / POWER_TIME, 1.0) * (square - self._power)
        ratio = np.zeros(self._driven_by.shape)
        if samples.injected and not self._injected:
            # Samples from before it have other instruments, which answer disturbances.
            self._error = ModelError(self._layout)
        self._injected = samples.injected
        if samples.injected:
            share = self._influence(samples)
            samples = replace(samples, z=share * samples.z)
            white = replace(white, z=share * white.z)
        else:
            self._feedback.add(samples, moments, weight)
            ratio = self._feedback.ratio[self._driven_by]
        gathered = RowSamples.of(samples, residual).pick(self._layout)
        # Late or answering gusts: where nothing was known before, either is a reason to deny.
        told = self._told * ratio[: len(ROWS)]
        self._error.add(gathered, weight, told, restarted=samples.restarted)
        weight = self._row_weights(weight)
        self._reference.add(gathered, weight, ratio)
        self._whitened.add(white.pick(self._layout), weight, ratio)
        if self._least_squares is not None:
            self._least_squares.add(gathered.uninstrumented(), weight, ratio)
        self._follow_changes(samples, gathered, weight)
        self._since_white += samples.time
        if self._since_white >= WHITENED_TIME - 0.5 * samples.dt:
            self._white = self._whitened.solve(self.coefficients)
            self._since_white = 0.0
        self._accept(self._solve())

    def _influence(self, samples: Regression) -> float:
        """Factor of the instruments of injected samples, 0 ... 1.

        While coefficients are poor the response of the model may be ten times that of the aircraft,
        and a second of it would outweigh a minute (bounded influence; Mallows 1975).
        """
        response = np.square(samples.z[:, RATE_COLUMNS]).max(axis=0)
        allowed = LARGEST_LEVERAGE * self._power
        over = np.divide(response, allowed, out=np.zeros_like(response), where=allowed > 0.0)
        return float(1.0 / np.sqrt(max(over.max(), 1.0)))

    def _row_weights(self, weight: FloatArray) -> FloatArray:
        """Weights of all rows (rows,): forces count as the moments that are learned with them."""
        if self._layout.rows == len(weight):
            return weight
        return np.array([*weight, max(weight[0], weight[2]), weight[1]])

    def _solve(self) -> Solution:
        """Return the solution that is published, with the standard deviations that it has."""
        solution = reference = self._reference.solve(self.coefficients)
        sigma = solution.sigma
        if self._least_squares is not None:
            solution = self._least_squares.solve(self.coefficients)
            sigma = np.hypot(solution.sigma, solution.values - reference.values)
        sigma = np.maximum(sigma, self._white.sigma)
        sigma = np.hypot(sigma, solution.values - self._white.values)
        main = np.arange(len(ROWS)), MAIN_COLUMNS
        sigma[main] = np.hypot(sigma[main], self.model_error * solution.values[main])
        sigma = np.hypot(sigma, MODEL_ERROR * solution.values)
        return replace(solution, sigma=np.where(self._start.free, sigma, self._start.sigma))

    def _accept(self, solution: Solution) -> None:
        """Take a solution, unless a row makes no sense: then all starts anew where it stood."""
        sane = (np.abs(solution.values) < LARGEST_COEFFICIENT) & np.isfinite(solution.sigma)
        if not sane.all():  # NaN fails too
            self.forget(0.0)
            return
        values = np.minimum(solution.values, self._bounds)
        self._solution, self.coefficients, self.sigma = solution, values, solution.sigma

    def reconfigure(self, settings: Settings) -> None:
        """Take over the settings that may change in flight."""
        self._reference.information.forgetting_time = settings.forgetting_time
        self._whitened.information.forgetting_time = settings.forgetting_time
        self.information.forgetting_time = settings.forgetting_time
        self._gate.settings = settings.supervision

    def forget(self, weight: float) -> None:
        """Let all that was learned so far count for `weight` of what it did."""
        self._reference.discount(weight)
        self._whitened.discount(weight)
        if self._least_squares is not None:
            self._least_squares.discount(weight)
        self._detector = ChangeDetector(self._start.free[:3], self._cutoff)
        self._recent.clear()
        self._snapshots.clear()
        self._trials.clear()

    # -- changes in flight -----------------------------------------------------------------

    def _follow_changes(
        self, samples: Regression, gathered: RowSamples, weight: FloatArray
    ) -> None:
        """Release what has changed, and take back a release that does not prove itself."""
        self._recent.append(gathered)
        while sum(part.time for part in self._recent) > READD_TIME + 0.5 * gathered.dt:
            self._recent.popleft()
        for row in list(self._trials):
            self._continue_trial(row, gathered, weight)
        lively = self._gate.share >= LIVELY_SHARE
        sigma = self._white.sigma[: len(ROWS), INPUT_COLUMNS]
        linear = self._linear(self._white)[: len(ROWS)]
        changed = self._detector.update(samples, linear, sigma, lively, self.clear)
        self.changes = []
        for i, j in changed:
            self.changes.append((i, CONSTANT_COLUMN if j == CONSTANT else INPUT_COLUMNS.start + j))
            self._release(i, j)
        self._since_snapshot += samples.time
        if self._since_snapshot >= SNAPSHOT_TIME - 0.5 * samples.dt:
            self._snapshots.append(self._white)
            self._since_snapshot = 0.0

    def _sums(self) -> Sums:
        return self._reference.sums if self._least_squares is None else self._least_squares.sums

    def _set_row(self, row: int, sums: Sums) -> None:
        if self._least_squares is None:
            self._reference.set_row(row, sums)
        else:
            self._least_squares.sums.set_row(row, sums)

    def _beside(self) -> list[InstrumentalVariable]:
        """Estimates whose distance sigma covers: they must follow a change too."""
        if self._least_squares is None:
            return [self._whitened]
        return [self._whitened, self._reference]

    def _release(self, row: int, j: int) -> None:
        """Forget what input `j` did in one row, back to before the change, and learn it anew.

        A covariance reset: of all that was known before, the covariance of this coefficient and of
        the constant, which takes up part of any change about a trim, are set to what a change
        by so much allows. Where the constant alone has changed, by a step, what came before the
        step tells nothing of it.
        """
        found, information, white = self._detector.found, self.information, self._white
        sums = self._sums().copy()
        beside = [other.sums.copy() for other in self._beside()]
        self._trials[row] = Trial(sums.copy(), white.linear[row].copy(), beside)
        known = self._snapshots[0] if self._snapshots else white
        mean, covariance = known.linear[row].copy(), known.covariance[row].copy()
        columns = self._layout.index[row].tolist()
        newest = sum(part.y.shape[1] for part in self._recent)
        if j == CONSTANT:
            step = self._detector.step(row)
            mean[columns.index(CONSTANT_COLUMN)] += step.size
            newest = step.samples
        else:
            entry, shift = columns.index(INPUT_COLUMNS.start + j), float(found.slope[row, j])
            mean[entry] += shift
            spread = max(float(found.deviation[row, j]), SLOPE_ERROR * abs(shift))
            covariance[entry, entry] += spread**2
            self._forget_prior(row, INPUT_COLUMNS.start + j)
        if CONSTANT_COLUMN in columns:
            constant = columns.index(CONSTANT_COLUMN)
            covariance[constant, constant] += self._start.sigma[row, CONSTANT_COLUMN] ** 2
        free = information.free[row]
        sums.set_known(row, mean, covariance, free, float(information.unit[row]))
        for other in self._beside():
            known_there = other.sums.copy()
            unit = float(other.information.unit[row])
            known_there.set_known(row, mean, covariance, free, unit)
            other.set_row(row, known_there)
        alone = np.zeros(self._layout.rows)
        alone[row] = 1.0
        sums.add(self._instrumented(RowSamples.join(self._recent, newest)), alone)
        self._set_row(row, sums)
        self._error.forget(row)

    def _forget_prior(self, row: int, column: int) -> None:
        """Let nothing from before the flight hold a coefficient where it was."""
        sigma = self._start.sigma.copy()
        sigma[row, column] = weak_sigma(self._structure)[row, column]
        self.start = replace(self._start, sigma=sigma)

    def _instrumented(self, samples: RowSamples) -> RowSamples:
        """Return samples with the instruments that the estimate in use has."""
        plain = self._least_squares is not None or self._reference.warming_up
        return samples.uninstrumented() if plain else samples

    def _continue_trial(self, row: int, samples: RowSamples, weight: FloatArray) -> None:
        """Compare the old with the new coefficients on samples that neither has seen."""
        trial = self._trials[row]
        trial.before.add(self._instrumented(samples), weight)
        y, f = samples.y[row], samples.f[row]
        trial.old_error += float(((y - f @ trial.old) ** 2).sum())
        trial.new_error += float(((y - f @ self._solution.linear[row]) ** 2).sum())
        trial.time += samples.time
        if trial.time >= TRIAL_TIME:
            del self._trials[row]
            if trial.new_error > TRIAL_RATIO * trial.old_error:
                self._set_row(row, trial.before)
                for other, sums in zip(self._beside(), trial.beside, strict=True):
                    other.set_row(row, sums)


def _driven_by(layout: Layout) -> NDArray[np.intp]:
    """Input that each instrument follows, (rows, k): itself, or else the main one of the row."""
    main = MAIN_COLUMNS - INPUT_COLUMNS.start
    rows = np.array([*main, main[2], main[1]])[: layout.rows]  # side force by rudder, lift by de
    own = layout.index - INPUT_COLUMNS.start
    is_input = (own >= 0) & (own < len(INPUTS))
    return np.where(is_input, own, rows[:, None])
