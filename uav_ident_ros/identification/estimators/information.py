# SPDX-License-Identifier: Apache-2.0
"""Accumulated information, and the coefficients and standard deviations that follow from it.

For each row ``R = sum z f^T``, ``S = sum z z^T``, ``r = sum z y``. With ``z = f`` the solution of
``R a = r`` is least squares. With the regressors of the model's own state as ``z`` it is the
instrumental variable. Both are the law ``Am_dot = e f^T K`` with a computed gain. The solved
equation is the projected form with a prior (two-stage least squares),

    a = (R^T S^-1 R + P)^-1 R^T S^-1 r.

It is R^-1 r where the instruments are strong, and goes to the prior where they are weak.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.prior import RATE_SIGMA, Start, physical_bounds
from uav_ident_ros.identification.regression import Layout, RowSamples, diagonal, layout
from uav_ident_ros.identification.scales import (
    DOUBTLESS,
    INDEPENDENT_TIME,
    OUTLYING,
    RESPONSE_TIME,
    REST_SWAY,
    ROUNDING,
    SHORT_MEMORY,
    TINY,
)
from uav_ident_ros.identification.structure import ROWS, BoolArray, FloatArray, Structure

FIRST_RESIDUAL_VARIANCE = (RATE_SIGMA * REST_SWAY) ** 2
"""Residual variance before the first measured one, rad^2/s^4: what an unknown damping makes of the
sway of an aircraft at rest. Such a motion then moves the damping by less than its prior sigma."""

MODEL_ERROR = 0.03
"""Error of a coefficient, relative to its value, that no residual shows: one value holds for a
range of speeds and angles. After excited flights of five aircraft in calm air the control
derivatives are off by 2.4 % rms, all dominant ones by 3.4 (benchmarks/derivatives.py)."""

POWERLESS = TINY**0.5
"""Power below which an instrument counts as zero: the product of two scales must stay finite."""

COLLINEAR_EIGENVALUE = 0.5 / DOUBTLESS**2
"""Eigenvalue of the scaled information below which its direction is unknown; 1 if all regressors
are uncorrelated. The sigmas of two regressors with this eigenvalue grow by `DOUBTLESS`: their
correlation is 97 %."""


_FROM_KAPPA = np.array([[1.0], [0.0]])
"""Least kappa of each kind of feedback: that by chance or not, and that which is significant."""


class Sums:
    """Accumulated sums of several estimates, the parts.

    All sums are in one table, row by row; the attributes are views of it.
    """

    def __init__(
        self,
        table: FloatArray,  # (parts, rows, k (1 + 7 k) + 3)
        k: int,  # Coefficients of a row
    ) -> None:
        self.table, self.k = table, k
        shape, square = table.shape[:2], k * k
        first = k + 2 * square
        # Side by side, each times dt: r = sum z y, R = sum z f^T, S = sum z z^T
        self.products = table[..., :first].reshape(*shape, k, 1 + 2 * k)
        self.zy, self.zf = self.products[..., :1], self.products[..., 1 : 1 + k]
        self.zz = self.products[..., 1 + k :]
        squares = table[..., first:-3].reshape(*shape, 5, k, k)
        # sum q z z^T, sum R^2 z z^T and that of the significant R^2, times dt: see `Feedback`
        self.answers = squares[:, :, :3]
        # Sum of g g^T over blocks, g the sum of z e over a block, times dt; sum f f^T over the time
        # with feedback, times dt
        self.scores, self.power = squares[:, :, 3], squares[:, :, 4]
        # Number of blocks; time with feedback, by chance or not, s; sum of the squares of the main
        # input's instrument, of injected samples, times dt
        self.blocks, self.answer_time, self.injected = (table[..., k] for k in (-3, -2, -1))

    @classmethod
    def empty(cls, parts: int, rows: int, k: int) -> Self:
        """Return empty sums."""
        return cls(np.zeros((parts, rows, k * (1 + 7 * k) + 3)), k)

    def __getitem__(self, parts: slice) -> Sums:
        """Return views of some of the parts."""
        return Sums(self.table[parts], self.k)

    def add(
        self,
        samples: RowSamples,
        weight: FloatArray,  # (rows,) Weight of the samples
        # (rows, 3, k, k) Weights of each pair of instruments in `answers`; None without feedback
        answering: FloatArray | None = None,
    ) -> FloatArray:
        """Add samples of all parts; return the sum of ``z e`` times dt, (parts, rows, k)."""
        k = self.k
        weighted = samples.z * (samples.dt * weight)[:, None, None]
        products = weighted.swapaxes(-1, -2) @ samples.signals
        self.products += products[..., 1:]
        if answering is not None:
            # pairs of instruments side by side: three times as quick as index by index
            answers = self.answers.reshape(*self.blocks.shape, 3, k * k)
            zz = products[..., 2 + k :].reshape(*self.blocks.shape, 1, k * k)
            answers += zz * answering.reshape(-1, 3, k * k)
            self.answer_time += samples.time * weight
            f = samples.f
            self.power += (f * (samples.dt * weight)[:, None, None]).swapaxes(-1, -2) @ f
        return np.asarray(products[..., 0])

    def weigh(self, keep: FloatArray) -> None:
        """Multiply the sums so far by `keep`, (rows,)."""
        self.table *= keep[..., None]
        self.scores *= keep[..., None, None]

    def set_known(
        self,
        row: int,
        mean: FloatArray,  # (k,) Coefficients
        covariance: FloatArray,  # (k, k)
        free: BoolArray,  # (k,) Coefficients that the covariance is of
        unit: FloatArray,  # (parts,) As `Information.unit`
    ) -> None:
        """Replace the sums of one row by a mean and a covariance: a covariance reset."""
        pairs = np.ix_(free, free)
        precision = np.zeros_like(covariance)
        precision[pairs] = np.linalg.inv(covariance[pairs])
        known = unit[:, None, None] * precision
        self.table[:, row] = 0.0
        self.zf[:, row] = self.zz[:, row] = known
        self.zy[:, row] = (known @ mean)[..., None]
        self.scores[:, row] = unit[:, None, None] * known
        self.blocks[:, row] = 1.0 / ROUNDING  # No correction for a small number of blocks


class Solution(NamedTuple):
    """Coefficients of some parts, and the equations solved.

    The equations are ``(B^T S^-1 B + P) a = B^T S^-1 r`` with B = R T, row by row.
    """

    values: FloatArray  # (parts, R, n) Coefficients of the structure
    unbounded: FloatArray  # (parts, R, n) The same without bounds
    linear: FloatArray  # (parts, rows, k) Coefficients of the regression problem
    sums: Sums  # Sums of the equations
    transform: FloatArray  # (rows, k, k) T, from the structure's coefficients to the linear ones
    projected: FloatArray  # (parts, rows, k, k) B^T S^-1 without the last scale
    scale: FloatArray  # (parts, rows, k, 1) Of the instruments
    matrix: FloatArray  # (parts, rows, k, k) B^T S^-1 B + P
    prior: FloatArray  # (parts, rows, k) Diagonal of P


class Information:
    """Information of the samples so far, with prior and forgetting.

    Estimates from the same samples, plain or whitened, are parts that run side by side. Those with
    instruments begin as least squares for `SHORT_MEMORY`, since instruments need a model. The sums
    of that start are biased and fade with the same time constant. An abrupt end would leave too
    little information after little excitation. A row that begins anew is least squares for
    `RESPONSE_TIME`.
    """

    def __init__(
        self,
        structure: Structure,
        start: Start,  # Initial coefficients, their sigma, flags of the free ones
        correlation_time: float,  # Of the residuals, s: that of the regression's filter
        forgetting_time: float = 0.0,  # Time constant, s; 0 for none; may change at any time
        instrumental: Sequence[bool] = (False,),  # Of each part; least squares if false
    ) -> None:
        self.layout = layout(structure)
        self.forgetting_time = forgetting_time
        self._structure = structure
        self._unit_time = correlation_time
        self._instrumental: BoolArray = np.array(instrumental)
        parts, rows, k = len(instrumental), self.layout.rows, self.layout.width
        self._i, self._j = self.layout.place[..., 0], self.layout.place[..., 1]
        self._used = np.flatnonzero(self.layout.used)
        self._places = (structure.size * self._i + self._j).ravel()[self._used]
        self._transform = Transform(structure, self.layout)
        self.set_start(start)
        self.sums = Sums.empty(parts, rows, k)
        # Rows whose regressors are still their own instruments, and the end of that time, s
        self.warming_up: BoolArray = np.full(rows, any(instrumental))
        self._warm_at: FloatArray = np.full(rows, SHORT_MEMORY)
        # Sums of that time, and the share of them that is left
        self._fading, self._faded = Sums.empty(parts, rows, k), np.zeros(rows)
        # Running residual variance, (parts, rows)
        self.variance: FloatArray = np.full((parts, rows), FIRST_RESIDUAL_VARIANCE)
        self.time: FloatArray = np.zeros(rows)  # Time of learning of each row, s
        self._score: FloatArray = np.zeros((parts, rows, k))
        self._score_time: FloatArray = np.zeros(rows)

    def set_start(self, start: Start) -> None:
        """Replace initial coefficients, standard deviations, and flags of the free ones."""
        self.start = start
        used = self.layout.used
        self._initial = self._entries(start.values)
        self.free: BoolArray = used & start.free[self._i, self._j]
        self._precision = np.where(self.free, start.precision[self._i, self._j], 0.0)
        self._prior_variance = np.where(self.free, start.sigma[self._i, self._j] ** 2, 0.0)
        known = used & start.known_a_priori(self._structure)[self._i, self._j]
        rows = known.any(axis=1)
        rows[: len(ROWS)] = known[range(len(ROWS)), self.layout.main]
        self._before = rows[:, None, None] / self._unit_time
        self._moves: FloatArray = self.free * 1.0
        self._pairs = self._moves[:, :, None] * self._moves[:, None, :]
        self._rest = np.where(self.free, TINY, 1.0)
        self._lost = self.free.sum(axis=1)
        bounds = physical_bounds(self._structure, start.free)[self._i, self._j]
        # At most one coefficient of a row is bounded: its rate's damping or its angle's slope.
        self._bounded = np.nonzero(self.free & np.isfinite(bounds))
        self._room = bounds[self._bounded] - self._initial[self._bounded][:, 0]

    @property
    def unit(self) -> FloatArray:
        """Residual variance times its correlation time: the unit of information, (parts, rows)."""
        return self.variance * self._unit_time

    def sums_of(self, parts: slice = slice(None)) -> Sums:
        """Return all sums of some parts."""
        return Sums(self.sums.table[parts] + self._fading.table[parts], self.sums.k)

    def add(
        self,
        samples: Sequence[RowSamples],
        weight: FloatArray,
        answering: FloatArray | None = None,
        *,
        injected: bool = False,  # Whether the instruments are the response to injected signals
    ) -> None:
        """Add the samples of each part, as `Sums.add`; a row of weight 0 stays as it is."""
        if (rows := self.warming_up & (self.time.max() >= self._warm_at)).any():
            # These rows begin with instruments; their sums without them fade.
            self.warming_up = self.warming_up & ~rows
            self._faded[rows] = 1.0
            moved = self._instrumental[:, None] & rows
            self._fading.table[moved] = self.sums.table[moved]
            self.sums.table[moved] = 0.0
        stack = RowSamples(np.array([part.signals for part in samples]), samples[0].dt)
        plain = ~self._instrumental[:, None] | self.warming_up
        stack.z[plain] = stack.f[plain]
        time, begun = weight * stack.time, self.time > 0.0
        if self._faded.any():
            keep = np.exp(time / -SHORT_MEMORY)
            self._fading.weigh(keep)
            self._faded *= keep
            if self._faded.max() < ROUNDING:
                self._fading.table[:] = self._faded[:] = 0.0
        score = self.sums.add(stack, weight, answering)
        if injected:
            moments = np.arange(len(ROWS))
            power = np.square(stack.z[:, moments, :, self.layout.main]).sum(axis=-1).T
            self.sums.injected[:, moments] += stack.dt * weight[moments] * power
        residual = stack.residual
        # The error of coefficients without information is no residual.
        square = np.minimum(residual * residual, OUTLYING * self.variance[..., None])
        share = np.minimum(time / np.minimum(SHORT_MEMORY, self.time + INDEPENDENT_TIME), begun)
        mean = np.add.reduce(square, axis=-1) / residual.shape[-1]
        self.variance += share * (mean - self.variance)
        self.time += time
        self._score += begun[:, None] * score
        self._score_time += time
        if max(self._score_time.tolist()) >= INDEPENDENT_TIME:
            # Add the scores of the rows whose block is full, and forget.
            full = self._score_time >= INDEPENDENT_TIME
            score = full[:, None] * self._score
            self.sums.scores += score[..., :, None] * score[..., None, :]
            self.sums.blocks += full
            if self.forgetting_time > 0.0:
                self.sums.weigh(np.exp(full * self._score_time / -self.forgetting_time))
            self._score[:, full] = self._score_time[full] = 0.0

    def injected_share(self, sums: Sums) -> FloatArray:
        """Return the share of the main inputs' power that was injected, of moment rows, (3,)."""
        moments = np.arange(len(ROWS))
        power = sums.zz[0, moments, self.layout.main, self.layout.main]
        return np.asarray(sums.injected[0, moments] / np.maximum(power, POWERLESS))

    def linear_of(self, values: FloatArray) -> FloatArray:
        """Return coefficients of the regression problem, (rows, k), of the structure's (R, n)."""
        return np.asarray((self._transform(values) @ self._entries(values))[..., 0])

    def _entries(self, values: FloatArray) -> FloatArray:
        """Return coefficients of the structure, (R, n), row by row of the problem, (rows, k, 1)."""
        return np.where(self.layout.used, values[self._i, self._j], 0.0)[..., None]

    def begin_anew(self, rows: BoolArray) -> None:
        """Clear the information of some rows, (rows,), when an excitation begins."""
        self.sums.table[:, rows] = self._fading.table[:, rows] = 0.0
        self._score[:, rows] = self._score_time[rows] = 0.0
        self.warming_up = self.warming_up | (rows & self._instrumental.any())
        self._warm_at[rows] = self.time.max() + RESPONSE_TIME

    def instrumented(self, samples: RowSamples) -> RowSamples:
        """Return samples with the present instruments of the first part."""
        rows = RowSamples(samples.signals.copy(), samples.dt)
        plain = ~self._instrumental[0] | self.warming_up
        rows.z[plain] = rows.f[plain]
        return rows

    def discount(self, keep: float) -> None:
        """Multiply all sums by `keep`."""
        self.sums.table *= keep
        self._fading.table *= keep

    def set_row(self, row: int, sums: Sums) -> None:
        """Replace all sums of one row."""
        self.sums.table[:, row] = sums.table[:, row]
        self._fading.table[:, row] = 0.0

    # -- solution --------------------------------------------------------------------------

    def solve(self, values: FloatArray, parts: slice = slice(None)) -> Solution:
        """Solve for the change from the start, with instruments scaled to a unit diagonal of S.

        Feedback is worth a few samples, however long it lasts. In rows with a control derivative
        known a priori, S therefore contains the feedback (the weights of the generalised method of
        moments; Hansen 1982). The prior then weighs more, and an instrument whose coefficient it
        determines does not bias the others. In other rows the prior only limits noise, and S has no
        such term. The force rows of the present coefficients, `values` (R, n), turn forces into
        flow angles.
        """
        sums, transform = self.sums_of(parts), self._transform(values)
        weighed = sums.zz + sums.answer_time[..., None, None] * self._before * sums.answers[:, :, 0]
        power = np.maximum(weighed.diagonal(axis1=2, axis2=3), POWERLESS)
        scale = (self._moves / np.sqrt(power))[..., None]
        prior = self._precision * self.unit[parts][..., None]
        instruments = weighed * (scale * scale.swapaxes(-1, -2))
        diagonal(instruments)[...] += ROUNDING  # Regular where they are collinear
        slope = sums.zf @ transform
        target = scale * (sums.zy - slope @ self._initial)
        slope *= scale * self._pairs
        projected = np.linalg.solve(instruments, slope).swapaxes(-1, -2)
        matrix = projected @ slope
        diagonal(matrix)[...] += prior + self._rest
        try:
            change: FloatArray = np.linalg.solve(matrix, projected @ target)
        except np.linalg.LinAlgError:
            change = np.full_like(target, np.nan)
        unbounded = found = self._placed((self._initial + change)[..., 0], self.start.values)
        held = self._within_bounds(change, matrix)
        physical = self._initial + held
        if held is not change:
            found = self._placed(physical[..., 0], self.start.values)
        linear = (transform @ physical)[..., 0]
        return Solution(found, unbounded, linear, sums, transform, projected, scale, matrix, prior)

    def _within_bounds(self, change: FloatArray, matrix: FloatArray) -> FloatArray:
        """Hold a coefficient at its bound, and move the others to their most likely values then.

        This is least squares with one active bound: a step along a column of the inverse of
        `matrix` (parts, rows, k, k). The least-squares start has no bound in moment rows: it is
        biased, and its residuals give the first noise variance.
        """
        rows, entries = self._bounded
        beyond = np.fmax(change[:, rows, entries] - self._room[:, None], 0.0)
        beyond[:, self.warming_up[rows] & (rows < len(ROWS))] = 0.0
        if not beyond.any():
            return change
        unit = np.zeros_like(change[0])
        unit[rows, entries] = 1.0
        step = np.linalg.solve(matrix, np.broadcast_to(unit, change.shape))
        held, size = change.copy(), beyond / step[:, rows, entries]
        held[:, rows] -= size[..., None] * step[:, rows]
        return held

    def spread(self, solution: Solution) -> tuple[FloatArray, FloatArray]:
        """Return covariances and standard deviations of the coefficients of all parts.

        The form is ``G Omega G^T``, with Omega the sum of the outer products of the scores of
        one-second blocks. It holds for residuals coloured within a block, where ``s^2 R^-1`` is
        several times too small (block-mean form of Morelli and Klein 1997). The prior and the
        feedback add their parts.

        The covariance is that of the structure's coefficients at their entries, row by row, without
        feedback, (parts, rows, k, k). The standard deviations, (parts, R, n), include feedback;
        those of fixed coefficients stay.
        """
        sums, prior = solution.sums, solution.prior
        try:
            inverse = np.linalg.inv(solution.matrix)
        except np.linalg.LinAlgError:
            inverse = np.full_like(solution.matrix, np.nan)
        gain = inverse @ solution.projected * solution.scale.swapaxes(-1, -2)
        middle = sums.scores * self.correction(sums)[..., None, None]
        held = inverse * (prior**2 * self._prior_variance)[..., None, :]
        covariance = gain @ middle @ gain.swapaxes(-1, -2) + held @ inverse.swapaxes(-1, -2)
        variance = np.maximum(diagonal(covariance), 0.0)
        for part in range(len(variance)):
            if part != 1:  # Not the whitened part: an innovation precedes the feedback from it
                variance[part] += self._answered(solution, part, gain[part])
        out = self._placed(variance, np.zeros_like(self.start.values))
        # The uncertainty of a force row that defines a flow angle adds to that of the moment. Its
        # factor is the share of the samples, 1 without a prior.
        row, column, entry, angle, force = self._transform.by_force
        resolved = (1.0 - diagonal(inverse) * prior)[:, row, entry] ** 2
        out[:, row, column] += (
            solution.linear[:, row, angle] ** 2 * out[:, force, column] * resolved
        )
        return covariance, np.where(self.start.free, np.sqrt(out), self.start.sigma)

    def correction(self, sums: Sums) -> FloatArray:
        """Return the factor of the scatter of few blocks, (parts, rows): k coefficients cost k."""
        return np.asarray(1.0 + self._lost / np.maximum(sums.blocks - self._lost, 1.0))

    def _answered(self, solution: Solution, part: int, gain: FloatArray) -> FloatArray:
        """Return the largest error by feedback, squared, (rows, k).

        With C of `Feedback` the errors d are at most ``d d^T = sigma_w^2 K``,
        ``K = G C G^T / sigma_w^2``. They explain a part ``d f`` of the acceleration, and hide that
        part of the disturbance from the residual: ``sigma_w^2 = sigma_e^2 + d^T F d``, F the mean
        of ``f f^T``. So d is in the ellipsoid ``d^T (K^-1 - F) d <= sigma_e^2``: along an
        eigenvector of ``K F`` with eigenvalue kappa, the error that K allows by ``sigma_e^2`` is
        divided by ``1 - kappa``. From kappa = 1 on the error may follow the disturbance and leave
        no residual. Only the prior and the distance from the start then bound it, and feedback that
        may be chance counts, too.
        """
        sums = solution.sums
        if not sums.answers[part].any() or not np.isfinite(gain).all():
            return np.zeros(gain.shape[:2])
        # K contains the time with feedback as a factor, F as a divisor: neither does here.
        power = solution.transform.swapaxes(-1, -2) @ sums.power[part] @ solution.transform
        level = (self.variance[part] * sums.answer_time[part])[:, None]
        moved = solution.values[part][self._i, self._j] - self._initial[..., 0]
        before = np.maximum(self._prior_variance + moved**2, POWERLESS)[..., None]
        answers = sums.answers[part, :, 1:].copy()
        power_of = diagonal(answers)
        power_of += ROUNDING * power_of + POWERLESS
        half = gain[:, None] @ np.linalg.cholesky(answers)
        kappa, directions = np.linalg.eigh(half.swapaxes(-1, -2) @ power[:, None] @ half)
        along = (half @ directions) ** 2
        known = 1.0 / np.maximum(np.add.reduce(along / before[:, None], axis=-2), POWERLESS)
        reach = np.minimum(level[:, None] / np.maximum(1.0 - kappa, ROUNDING), known)
        reach *= kappa >= _FROM_KAPPA
        return np.asarray(np.maximum.reduce((along @ reach[..., None])[..., 0], axis=1))

    def _placed(self, entries: FloatArray, over: FloatArray) -> FloatArray:
        """Return `over` (R, n) with entries (parts, rows, k) at their places in the structure."""
        out = np.empty((len(entries), over.size))
        out[:] = over.ravel()
        out[:, self._places] = entries.reshape(len(out), -1).take(self._used, axis=1)
        return out.reshape(-1, *over.shape)

    # -- diagnostics of the first part ------------------------------------------------------

    def _correlation(self) -> FloatArray:
        """Information of the moment rows, scaled to a unit diagonal, symmetric, (3, k, k)."""
        matrix = (self._pairs * self.sums.zf[0])[:3]
        matrix = 0.5 * (matrix + matrix.transpose(0, 2, 1))
        power = diagonal(matrix)
        power += (self._precision * self.unit[0, :, None] + self._rest)[:3]
        scale = 1.0 / np.sqrt(np.abs(power))
        return np.asarray(matrix * scale[:, :, None] * scale[:, None, :])

    def excitation(self) -> FloatArray:
        """Return the separability of the regressors of each moment row, shape (3,), 0 ... 1.

        It is the reciprocal of the largest variance inflation factor (Belsley, Kuh and Welsch
        1980): 1 if all regressors are uncorrelated, 0 if one follows from the others. It does not
        depend on their scales.
        """
        inverse = np.linalg.inv(self._correlation())
        inflation = np.abs(diagonal(inverse)).max(axis=1)
        return np.where(self.time[:3] > 0.0, 1.0 / np.maximum(inflation, 1.0), 0.0)

    def collinear(self) -> list[tuple[str, ...]]:
        """Return the names of collinear coefficients, a group an entry.

        A small eigenvalue of the scaled information is a direction without information. The columns
        with more than their share in its eigenvector are the group.
        """
        values, vectors = np.linalg.eigh(self._correlation())
        groups = []
        for i, row in enumerate(vectors):
            for value, vector in zip(values[i], row.T, strict=True):
                shares = self.free[i] & (self._lost[i] * vector**2 > 1.0)
                if value < COLLINEAR_EIGENVALUE and shares.sum() > 1:
                    names = self._regressors(i, shares)
                    groups.append(tuple(f"{ROWS[i]}/{name}" for name in names))
        return groups

    def correlations(self) -> dict[str, tuple[tuple[str, ...], FloatArray]]:
        """Return the correlations of the estimates of each moment row.

        Each entry is the row's free regressors, m names, and the correlation of their coefficients,
        (m, m).
        """
        found = {}
        for i, inverse in enumerate(np.linalg.inv(self._correlation())):
            places = np.flatnonzero(self.free[i])
            covariance = inverse[np.ix_(places, places)]
            scale = 1.0 / np.sqrt(np.abs(np.diag(covariance)))
            found[ROWS[i]] = self._regressors(i, places), covariance * np.outer(scale, scale)
        return found

    def _regressors(self, row: int, entries: BoolArray | NDArray[np.intp]) -> tuple[str, ...]:
        """Return the names of the regressors at some entries of a row."""
        return tuple(self._structure.regressors[j] for j in self._j[row, entries])


class Transform:
    """Matrices T from the structure's coefficients to the linear ones, (rows, k, k).

    An angle is a force over its slope, less the other contributions to that force.
    """

    def __init__(self, structure: Structure, layout: Layout) -> None:
        rows, k = layout.rows, layout.width
        self._one: FloatArray = np.broadcast_to(np.eye(k), (rows, k, k)).copy()
        # Places in T and their entries: a sign times one coefficient over another. The coefficients
        # are given by their places in the raveled array, with a one appended.
        one, entries = structure.mask.size, []
        # Entries of moment rows that depend on a force row: row, column of the structure, entry in
        # the row, that of the angle, and the row of the force
        by_force = []
        for flow in structure.flow:
            first = flow.force * structure.size
            slope = first + flow.angle
            for row, columns in enumerate(layout.index[: len(ROWS)].tolist()):
                if flow.angle not in columns:
                    continue
                angle = columns.index(flow.angle)
                entries.append((row, angle, angle, 1, one, slope))
                by_force.append((row, flow.angle, angle, angle, flow.force))
                for column in set(flow.others).intersection(columns):
                    entry = columns.index(column)
                    entries.append((row, entry, angle, -1, first + column, slope))
                    by_force.append((row, column, entry, angle, flow.force))
            for entry in np.flatnonzero(layout.place[flow.force, :, 0] == flow.kinematics):
                entries.append((flow.force, entry, entry, 1, slope, one))
        table = np.array(entries, dtype=np.intp).reshape(-1, 6).T
        self._at = np.ravel_multi_index(tuple(table[:3]), self._one.shape)
        self._sign, self._over, self._under = table[3:]
        self._known: FloatArray = np.ones(one + 1)
        self.by_force = np.array(by_force, dtype=np.intp).reshape(-1, 5).T

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return the matrices for coefficients of the structure (R, n)."""
        matrices, known = self._one.copy(), self._known
        known[:-1] = values.ravel()
        ratios = self._sign * known.take(self._over) / known.take(self._under)
        matrices.ravel()[self._at] = ratios
        return matrices
