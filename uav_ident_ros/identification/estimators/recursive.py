# SPDX-License-Identifier: Apache-2.0
"""Recursive regression: least squares or the instrumental variable, with guards.

Gyro noise and gusts are in the regressors and bias least squares. The regressors of the model's own
state are not correlated with them, which makes them instruments (Young 2011, SRIVC; here in
information form, for a nonlinear model). Guards are needed because the model runs while its
coefficients are still poor.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uav_ident_ros.identification.estimators.change import Change, ChangeDetector
from uav_ident_ros.identification.estimators.estimator import Estimator, SecondEstimator
from uav_ident_ros.identification.estimators.information import MODEL_ERROR, Solution
from uav_ident_ros.identification.estimators.model_error import ModelError, known_inputs
from uav_ident_ros.identification.gates import ExcitationGate
from uav_ident_ros.identification.prior import Start, weak_sigma
from uav_ident_ros.identification.regression import Regression, RowSamples, layout
from uav_ident_ros.identification.residuals import UNKNOWN_ANSWER, Feedback
from uav_ident_ros.identification.scales import (
    DOUBTLESS,
    LOOK_TIME,
    OUTLYING,
    SHORT_MEMORY,
    START_TIME,
    SURE,
    TINY,
)
from uav_ident_ros.identification.settings import LARGEST_NUMBER, Settings
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUTS,
    MAIN_COLUMNS,
    MAIN_DERIVATIVES,
    MAIN_PLACES,
    RATE_COLUMNS,
    ROWS,
    STRUCTURES,
    BoolArray,
    FloatArray,
)


class RecursiveRegression(Estimator):
    """Least squares or instrumental variable, in one pass.

    Rows pause in quiet flight, and a change resets the covariance of one control derivative only.
    The parts of `information` are the estimate in use, the whitened estimate, and for least squares
    the instrumental variable. Where only an autopilot moves the surfaces, in answer to gusts, the
    plain estimate is that of the autopilot, the whitened one less so. With excitation they agree.
    The bias of least squares in gusts is many times its own sigma. Sigma therefore covers the
    distances between the parts.

    Parameters
    ----------
    start : Start
        Initial coefficients, their standard deviations, and flags of the free ones.
    settings : Settings
        Structure, time constant of forgetting, and the excitation that a row needs.
    instrumental : bool
        Whether the instrumental variable gives the coefficients. If not, it only shows the bias of
        least squares.
    """

    def __init__(self, start: Start, settings: Settings, *, instrumental: bool) -> None:
        self._structure = STRUCTURES[settings.structure]
        self._rotors = settings.actuators.multirotor
        self._layout = layout(self._structure)
        self._error = ModelError(self._layout)
        self._feedback = Feedback(self._layout)
        # The reference estimator, without the informative prior, if there is one. A prior that
        # contradicts it is rejected.
        self._reference: SecondEstimator[RecursiveRegression] | None = None
        if start.informative(self._structure).any():
            weak = start.weakened(self._structure)
            blank = RecursiveRegression(weak, settings, instrumental=instrumental)
            self._reference = SecondEstimator(blank)
        self._power: FloatArray = np.zeros(len(ROWS))  # Mean square of the rates
        self._instrumental, self._injected, self._ever_injected = instrumental, False, False
        self._white_share: FloatArray | None = None
        parts = (True, True) if instrumental else (False, True, True)
        super().__init__(settings, start, parts, settings.forgetting_time)
        self._cutoff = settings.filter.cutoff
        self._gate = ExcitationGate(start.free[:3], settings.supervision)
        self._begin_changes()
        self._solve()

    def _begin_changes(self) -> None:
        """Restart the change detection."""
        self._detector = ChangeDetector(self.start.free, self._layout, self._cutoff)
        self._since_sigma = np.inf

    def set_start(self, start: Start) -> None:
        """Replace initial coefficients and prior, also those of the reference."""
        super().set_start(start)
        self.information.set_start(start)
        self._known_a_priori = start.known_a_priori(self._structure)[MAIN_DERIVATIVES]
        if self._reference:
            self._reference.estimator.set_start(start.weakened(self._structure))
        self.coefficients = np.where(start.free, self.coefficients, start.values)
        self.sigma = np.where(start.free, self.sigma, start.sigma)

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Add samples and solve."""
        reference_has_learned = self._reference is not None and self._reference.add(samples, weight)
        moments = rows.residual[: len(ROWS)].T
        seen = self._gate.update(samples, moments, self.coefficients[: len(ROWS)])
        self.clear, self.learning = self._gate.clear, self._gate.learning & (weight > 0.0)
        outlying, weight = weight < 1.0, weight * seen
        rates = samples.f[:, RATE_COLUMNS]
        square = np.add.reduce(rates * rates) / len(rates)
        self._power += min(samples.time / SHORT_MEMORY, 1.0) * (square - self._power)
        if samples.injected and not self._injected:
            # Earlier samples have other instruments, which contain feedback.
            self._error = ModelError(self._layout)
            if not self._ever_injected:
                self._begin_excited()
        self._injected = samples.injected
        if samples.injected:
            share = self._influence(samples)
            rows, white = rows.times(share), white.times(share)
            answers, answering = np.zeros(len(ROWS)), None  # Injected signals have no disturbance.
            self.answers = np.zeros(len(INPUTS))
        else:
            known = np.abs(self._known[0].values[1][MAIN_DERIVATIVES])  # whitened
            counted = moments * (weight > 0.0)  # a row learns nothing from the others
            self._feedback.add(samples, counted, weight, known)
            self.answers = self._feedback.share
            answers = self._feedback.ratio[range(len(ROWS)), self._layout.main]
            # Residuals of a wrong model follow the inputs: its reference knows the feedback better.
            reference = self._reference.estimator if self._reference else self
            answering = reference._feedback.answering
        self.may_answer = answers > 0.0
        # An input that answers gusts looks late, or as if it saturated. Unless its derivative is
        # known a priori, either denies the row.
        ratio = answers * self._agrees_with_prior
        # The height has no such knowledge, and chance must not hide it: it biases the aileron.
        rolls = float(answers[0]) if self.answers[MAIN_PLACES[0]] else 0.0
        settled = self.information.time.max() >= START_TIME
        restarted = samples.restarted
        # In quiet flight the samples contain only gusts and an autopilot's answers.
        looked = weight * self.learning
        force = tuple(places[len(ROWS) :] for places in self._layout.effects)
        known = np.abs(self.coefficients[force]) > SURE * self.sigma[force]
        self._error.add(
            rows, looked, ratio, rolls, self.linear, force_is_known=bool(known.any()),
            restarted=restarted, settled=settled, injected=samples.injected,
        )  # fmt: skip
        known_now = known_inputs(self.coefficients, self.sigma, self._error.lost)
        damping = -self.linear[: len(ROWS), RATE_COLUMNS].diagonal()
        self.model_error = self._error.relative_error(known_now, damping, self.delay, self._rotors)
        # Where gusts alone make the aircraft roll, their side force looks like a height.
        self.height = self._error.height if known_now[0] else 0.0
        weight = self._row_weights(weight)
        parts = (rows, white, rows)[: len(self.information.variance)]
        self.information.add(parts, weight, answering, injected=samples.injected)
        self._follow_changes(samples, outlying)
        if self._reference and reference_has_learned:
            self._reject_priors(self._reference.estimator)
        self.sure_error = self._error.lost
        self._since_sigma += samples.time
        self._solve(0.5 * samples.dt)

    @property
    def _agrees_with_prior(self) -> BoolArray:
        """Moment rows whose main control derivative is within its informative prior, (3,)."""
        away = np.abs(self.coefficients - self.start.values)[MAIN_DERIVATIVES]
        holds = away <= SURE * self.start.sigma[MAIN_DERIVATIVES]
        return np.asarray(self._known_a_priori & holds)

    def _begin_excited(self) -> None:
        """Clear the rows of unknown main derivative at the first injection.

        An autopilot's flight biases damping towards zero, and such a model's response is a poor
        instrument for the whole excitation. Least squares over its first seconds is better.
        """
        self._ever_injected = True
        known = known_inputs(self.coefficients, self.sigma, self._error.lost)
        self.information.begin_anew(self._row_weights(1.0 * known) == 0.0)
        self._since_sigma = np.inf

    def _influence(self, samples: Regression) -> float:
        """Return the factor of the instruments of injected samples, 0 ... 1.

        While coefficients are poor, the model's response may be ten times the aircraft's, and a
        second of it would outweigh a minute (bounded influence; Mallows 1975).
        """
        response = np.square(samples.z[:, RATE_COLUMNS]).max(axis=0)
        allowed = OUTLYING * self._power
        over = np.divide(response, allowed, out=np.zeros_like(response), where=allowed > 0.0)
        return float(1.0 / np.sqrt(max(over.max(), 1.0)))

    def _row_weights(self, weight: FloatArray) -> FloatArray:
        """Return weights of all rows, (rows,): a force row has that of its moments."""
        if self._layout.rows == len(weight):
            return weight
        p, q, r = weight.tolist()
        return np.array([p, q, r, max(p, r), q])

    def _solve(self, early: float = 0.0) -> None:
        """Solve; clear all information if a row diverges.

        Standard deviations follow every `LOOK_TIME`, or `early` s sooner.
        """
        due, before = self._since_sigma >= LOOK_TIME - early, self.coefficients
        mixes = self._instrumental and self._ever_injected
        solution = self.information.solve(before, slice(None) if due else slice(1 + mixes))
        if due:
            covariance, sigmas = self.information.spread(solution)
            self._white_share = self._least_variance(solution, sigmas) if mixes else None
        values, linear = solution.values[0], solution.linear[0]
        if self._white_share is not None:
            values = values + self._white_share * (solution.values[1] - values)
            linear = self.information.linear_of(values)
        sound = np.maximum.reduce(np.abs(values), axis=None) < LARGEST_NUMBER  # NaN fails too
        if due:
            sigma = self._sigma_of(values, solution, sigmas)
            sound = sound and bool(np.isfinite(sigma).all())
        if not sound:
            self.forget(0.0)
            return
        if due:
            self._known = solution, covariance
            self.sigma, self._since_sigma = sigma, 0.0
        self.linear = self._layout.matrix(linear)
        self.coefficients = values

    def _least_variance(self, solution: Solution, sigmas: FloatArray) -> FloatArray:
        """Return the share of the whitened estimate in the one in use, (R, n), 0 ... 1.

        Injected signals as instruments make both consistent: no disturbance is in them. Weighed by
        the inverse of their variances both together have the least variance (as in GLS; gusts are
        slow, and whitening removes most of them). With other instruments the plain one is in use:
        there the residual is the model's error as well. The share of what was injected in the
        information of a row leads from the one to the other, and so do the blocks beyond its k
        coefficients, up to twice k: fewer blocks tell neither noise nor variances.
        """
        plain, white, *_ = np.square(sigmas)
        share = plain / (plain + white + TINY)
        injected = self._row_weights(self.information.injected_share(solution.sums))
        injected /= np.maximum(self.information.correction(solution.sums)[0] - 1.0, 1.0)
        rows, entries = np.nonzero(self._layout.used)
        by_place = np.zeros_like(share)
        by_place[tuple(self._layout.place[rows, entries].T)] = injected[rows]
        return np.asarray(by_place * share)

    def _sigma_of(self, values: FloatArray, solution: Solution, sigmas: FloatArray) -> FloatArray:
        """Return the standard deviations of the estimate in use, (R, n), from those of the parts.

        They cover the distances between the parts. Estimates at a bound agree there, however far
        apart they are without it: the distances are those of the unbounded estimates, and the shift
        by the bound is added.
        """
        sigma, white_sigma, *_ = sigmas
        own, white, *reference = solution.unbounded
        for other in reference:
            sigma = np.hypot(sigma, own - other)
        distance = own - white
        if self._white_share is not None:
            distance *= np.maximum(self._white_share, 1.0 - self._white_share)
        sigma = np.hypot(np.maximum(sigma, white_sigma), distance)
        sigma = np.hypot(sigma, own - solution.values[0])
        share = np.full(len(values), MODEL_ERROR)
        share[: len(ROWS)] = np.hypot(MODEL_ERROR, self._error.lost)
        sigma = np.hypot(sigma, share[:, None] * values)
        return np.where(self.start.free, sigma, self.start.sigma)

    # -- rejection of priors ----------------------------------------------------------------

    def _rejected_priors(self, reference: RecursiveRegression) -> BoolArray:
        """Return flags of the coefficients whose prior the reference rejects, (R, n).

        The test is for a conflict of prior and data (Evans and Moshonov 2006), by a sigma that
        includes feedback. It needs inputs that stand out from disturbances. For main control
        derivatives that sigma is right from the first seconds on.
        """
        start = self.start
        off = np.abs(reference.coefficients - start.values)
        sure = off > DOUBTLESS * np.hypot(reference.sigma, start.sigma)
        clear = self._row_weights(1.0 * reference.clear) > 0.0
        rows = clear & (reference.information.time >= START_TIME)
        i, j = self._layout.place[self._layout.used & rows[:, None]].T
        seen = np.zeros_like(sure)
        seen[i, j] = True
        seen[MAIN_DERIVATIVES] = reference.clear
        return np.asarray(seen & sure & start.informative(self._structure))

    def _reject_priors(self, reference: RecursiveRegression) -> None:
        """Replace rejected priors by weak ones.

        A row whose main control derivative is among them loses all its informative priors. It takes
        over the sums of the reference, since its own residuals are those of a wrong model.
        """
        if not (against := self._rejected_priors(reference)).any():
            return
        for row in np.flatnonzero(against[MAIN_DERIVATIVES]).tolist():
            against[row] = True
            self.information.set_row(row, reference.information.sums_of())
            self.information.variance[:, row] = reference.information.variance[:, row]
            self._begin_changes()
            self.rejected.append((row, int(MAIN_COLUMNS[row])))
        self.changes += self.rejected
        self.set_start(self.start.weakened(self._structure, against))
        self._since_sigma = np.inf
        if not self.start.informative(self._structure).any():
            self._reference, self._feedback = None, reference._feedback

    def reconfigure(self, settings: Settings) -> None:
        """Apply the settings that may change in flight."""
        if self._reference:
            self._reference.estimator.reconfigure(settings)
        self.information.forgetting_time = settings.forgetting_time
        self._gate.settings = settings.supervision

    def forget(self, weight: float) -> None:
        """Multiply the information so far by `weight`."""
        if self._reference:
            self._reference.estimator.forget(weight)
        super().forget(weight)
        self._error = ModelError(self._layout)
        self._begin_changes()

    # -- changes in flight -----------------------------------------------------------------

    def _follow_changes(self, samples: Regression, outlying: BoolArray) -> None:
        """Detect changes, and reset the covariance of the coefficients that changed.

        Of the moment rows those in `outlying` have a residual far outside its usual size.
        """
        self.changes, self.rejected = [], []
        if self._detector.add(samples):
            linear = self._layout.matrix(self._known[0].linear[1])
            error = np.where(self._error.is_known, self.model_error, 1.0)
            # What an autopilot answers beside injected signals is not known.
            answers = UNKNOWN_ANSWER if self._injected else self._feedback.largest_answer
            for change in self._detector.look(linear, self.sigma, outlying, error, answers):
                column = MAIN_COLUMNS[change.row] if change.column is None else change.column
                self.changes.append((change.row, int(column)))
                self._release(change)

    def _release(self, change: Change) -> None:
        """Reset a changed coefficient, and learn it from the samples after the change.

        A surface that loses a share of its moment loses that share of its force, which is a part of
        the whole moment, and of its moments about the other axes. In a whole row all coefficients
        but those of rate products have changed.
        """
        row, column, size = change.row, change.column, change.size
        before, columns = self._known[0].linear[1], self._layout.place[..., 1]
        if column is None:
            moves = columns[row] >= RATE_COLUMNS.start
            self._reset(row, moves * size * before[row], change.after)
        else:
            moves = columns[row] == column
            effect = before[row, moves]
            self._reset(row, moves * size, change.after)
        others = [flow.force for flow in self._structure.flow if column in flow.others]
        if column == MAIN_COLUMNS[row]:
            others += [i for i in range(len(ROWS)) if i != row and self._structure.mask[i, column]]
        for other in others:
            alike = (columns[other] == column) * before[other]
            self._reset(other, alike / effect * size, change.after)
        self._error.begin_anew(row)
        self._since_sigma = np.inf

    def _reset(self, row: int, moved: FloatArray, samples: Regression) -> None:
        """Reset the covariance of coefficients that `moved`, (k,), and learn `samples` again.

        The coefficients move by `moved`, and their variances grow by its square. The variance of
        the row's constant grows to its prior's, since the constant takes up part of any change
        about a trim.
        """
        information, weak = self.information, weak_sigma(self._structure)
        rows, columns = np.moveaxis(self._layout.place[row], -1, 0)
        moved = moved * information.free[row]
        at = rows[moved != 0.0], columns[moved != 0.0]
        # No prior holds the coefficients at their former values.
        sigma = self.start.sigma.copy()
        sigma[at] = weak[at]
        self.set_start(replace(self.start, sigma=sigma))
        known, covariances = self._known  # whitened
        mean, transform = known.linear[1, row].copy(), known.transform[row]
        covariance = transform @ covariances[1, row] @ transform.T
        mean += moved
        own = (rows == row) & (columns == CONSTANT_COLUMN)
        constant = np.where(own, sigma[row, columns], 0.0)
        covariance += np.diag(constant**2 + moved**2)
        sums = information.sums_of()
        sums.set_known(row, mean, covariance, information.free[row], information.unit[:, row])
        after = RowSamples.of(samples, samples.residual(self.linear), self._layout)
        # The other parts learn from the samples to come.
        only = 1.0 * (np.arange(self._layout.rows) == row)
        sums[:1].add(information.instrumented(after), only)
        information.set_row(row, sums)
