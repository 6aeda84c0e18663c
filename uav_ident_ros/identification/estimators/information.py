# SPDX-License-Identifier: Apache-2.0
"""Accumulated information: ``R = sum z f^T``, ``r = sum z y`` for each row.

With ``z = f`` the solution of ``R a = r`` is least squares, with ``z`` the regressors of the
model's own state it is the instrumental variable. Both are the law ``Am_dot = e f^T K`` with
the gain ``K = R^-1``: computed, not chosen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import (
    AUGMENTED_REGRESSORS,
    CONSTANT,
    BoolArray,
    FloatArray,
)

BLOCK_TIME = 1.0
"""Length of the blocks whose scores are taken as independent, s: longer than the correlation
of gusts and filter."""

RESIDUAL_TIME = 5.0
"""Memory of the running residual variance, s: short, so that the large residuals before the
first excitation are soon forgotten; it weighs the prior alone."""

FIRST_RESIDUAL_VARIANCE = 0.1
"""Residual variance until there is a measured one, rad^2/s^4: filtered gyro noise."""

_RIDGE = 1e-9
"""Relative to a regressor's own information: keeps the solution defined where columns are
collinear."""


COLLINEAR_EIGENVALUE = 0.02
"""Eigenvalue of the scaled information below which its direction is unknown; 1 if all
regressors are uncorrelated."""

COLLINEAR_SHARE = 0.4
"""Component of the eigenvector from which a regressor belongs to the group."""

RELEASED_SHARE = 0.98
"""Share of a coefficient's information that a release takes out: what is left keeps the
solution from jumping on the first noisy sample."""

CONSTANT_COLUMN = AUGMENTED_REGRESSORS.index(CONSTANT)
"""Column of the constant, which takes up part of any change about a trim."""


@dataclass(frozen=True)
class Snapshot:
    """Copy of what is known: ``R`` (3, k, k), ``r`` (3, k), the scores ``S``, and the prior."""

    matrix: FloatArray
    vector: FloatArray
    scores: FloatArray
    blocks: FloatArray
    precision: FloatArray

    def scaled(self, weight: FloatArray) -> Snapshot:
        """Return it at a weight per row, shape (3,)."""
        row = weight[:, None, None]
        return Snapshot(
            self.matrix * row,
            self.vector * weight[:, None],
            self.scores * row**2,
            self.blocks * weight,
            self.precision,
        )


class Columns:
    """The free columns of each row, side by side: k of the n regressors, k the most in a row.

    Parameters
    ----------
    free : (3, n) bool array
        Coefficients that move.
    """

    def __init__(self, free: BoolArray) -> None:
        self.free = free
        self.counts = free.sum(axis=1)
        self.size = max(int(self.counts.max()), 1)
        self.index = np.zeros((3, self.size), dtype=np.intp)
        self.used = np.arange(self.size) < self.counts[:, None]
        for i, row in enumerate(free):
            self.index[i, : self.counts[i]] = np.flatnonzero(row)

    def gather(self, values: FloatArray) -> FloatArray:
        """Free entries, shape (3, k), of values of shape (3, n)."""
        return np.asarray(np.take_along_axis(values, self.index, axis=1) * self.used)

    def scatter(self, values: FloatArray) -> FloatArray:
        """Values of shape (3, n), zero where not free, from free entries of shape (3, k)."""
        out = np.zeros(self.free.shape)
        out[self.free] = values[self.used]
        return out


def _parts(sums: FloatArray, k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return views of R (3, k, k), r and score (3, k), in sums of shape (3, k * k + 2 * k)."""
    square = k * k
    matrix = sums[:, :square].reshape(3, k, k)
    return matrix, sums[:, square : square + k], sums[:, square + k :]


class Information:
    """Information of three rows, with forgetting and prior.

    Parameters
    ----------
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    forgetting_time : float
        Time constant of forgetting, s; 0 for never.

    Attributes
    ----------
    forgetting_time : float
        The parameter; it may change at any time.
    time : (3,) array
        How long each row has learned, s.
    sigma : (3, n) array
        Standard deviations as of the last full block; those of the start before the first.
    added : tuple of arrays
        What the last tick added to ``R`` and ``r``.
    """

    def __init__(self, start: Start, forgetting_time: float = 0.0) -> None:
        self._start = start
        self.forgetting_time = forgetting_time
        self.columns = Columns(start.free)
        k, n = self.columns.size, start.values.shape[1]
        self._precision = self.columns.gather(start.precision)
        # Where the entries of each row stand in the product of a tick, which is z by f,
        # deviations, residuals: first those of R, (k, k), then those of r and of the score, (k,).
        index, rows = self.columns.index, np.arange(3)[:, None]
        used, width = self.columns.used, n + 6
        matrix = index[:, :, None] * width + index[:, None, :]
        self._take = np.hstack(
            [matrix.reshape(3, -1), index * width + n + rows, index * width + n + 3 + rows]
        )
        pairs = used[:, :, None] & used[:, None, :]
        self._used = np.hstack([pairs.reshape(3, -1), used, used]) * 1.0
        self._sums: FloatArray = np.zeros((3, k * k + 2 * k))
        self.matrix, self.vector, self._score = _parts(self._sums, k)
        self.added: tuple[FloatArray, FloatArray] = (self.matrix, self.vector)
        self.residual_variance: FloatArray = np.full(3, FIRST_RESIDUAL_VARIANCE)
        self.time: FloatArray = np.zeros(3)
        self._square: FloatArray = np.zeros(3)
        self._scores: FloatArray = np.zeros((3, k, k))
        self._score_time: FloatArray = np.zeros(3)
        self._blocks: FloatArray = np.zeros(3)
        self._quiet: BoolArray | None = None
        self.sigma: FloatArray = np.where(start.free, start.sigma, 0.0)

    def accumulate(
        self,
        data: Regression,
        z: FloatArray,
        residual: FloatArray,
        weight: FloatArray,
        quiet: BoolArray | None = None,
    ) -> None:
        """Add the samples of a tick.

        Parameters
        ----------
        data : Regression
            Samples of y = A f.
        z : (m, n) array
            Instruments.
        residual : (m, 3) array
            Residuals from the estimate before the tick.
        weight : (3,) array
            How much the samples count in each row, 0 ... 1; a row with 0 stays as it is, the
            others also forget.
        quiet : (n,) bool array, optional
            Regressors that are not excited, and not forgotten.
        """
        self._quiet = quiet
        dt = (weight > 0.0) * data.dt
        weight = weight * data.dt
        # Deviations from the start, so that what is fixed or unexcited stays where it is.
        deviation = data.residual(self._start.values)
        product = z.T @ np.concatenate((data.f, deviation, residual), axis=1)
        added = product.take(self._take) * (weight[:, None] * self._used)
        self._sums += added
        self.added = _parts(added, self.columns.size)[:2]
        self._square += np.add.reduce(residual * residual) * dt
        self._score_time += dt * len(data.y)
        if max(self._score_time.tolist()) >= BLOCK_TIME:
            self._close_blocks(self._score_time >= BLOCK_TIME)

    def _close_blocks(self, full: BoolArray) -> None:
        """Count the scores of the rows whose block is full; forget; renew their sigma."""
        spent = np.where(full, self._score_time, 0.0)
        self.time += spent
        share = np.divide(spent, np.minimum(self.time, RESIDUAL_TIME), out=np.zeros(3), where=full)
        mean_square = np.divide(self._square, self._score_time, out=np.zeros(3), where=full)
        self.residual_variance += share * (mean_square - self.residual_variance)
        score = np.where(full[:, None], self._score, 0.0)
        self._scores += score[:, :, None] * score[:, None, :]
        self._blocks += full
        for sums in (self._score, self._square, self._score_time):
            sums[full] = 0.0
        if self.forgetting_time > 0.0:
            self._forget(np.exp(-spent / self.forgetting_time))
        self.sigma = self._compute_sigma()

    def add_sample(self, row: int, y: FloatArray, f: FloatArray, z: FloatArray, dt: float) -> None:
        """Add one sample, y (3,), f and z (n,), that stands for `dt` s to one row alone."""
        index, used = self.columns.index[row], self.columns.used[row]
        weighted = np.where(used, z[index] * dt, 0.0)
        self.matrix[row] += np.outer(weighted, np.where(used, f[index], 0.0))
        self.vector[row] += weighted * (y[row] - f @ self._start.values[row])

    def snapshot(self) -> Snapshot:
        """Return a copy of what was accumulated."""
        return Snapshot(
            self.matrix.copy(),
            self.vector.copy(),
            self._scores.copy(),
            self._blocks.copy(),
            self._precision.copy(),
        )

    def fade(self, part: Snapshot, keep: FloatArray) -> Snapshot:
        """Let one part of what was accumulated count for `keep` of what it did, per row.

        Returns
        -------
        Snapshot
            What is left of the part.
        """
        left = part.scaled(keep)
        self.matrix += left.matrix - part.matrix
        self.vector += left.vector - part.vector
        self._scores += left.scores - part.scores
        self._blocks += left.blocks - part.blocks
        return left

    def restore(self, row: int, snapshot: Snapshot) -> None:
        """Set one row to what a snapshot holds."""
        self.matrix[row] = snapshot.matrix[row]
        self.vector[row] = snapshot.vector[row]
        self._scores[row] = snapshot.scores[row]
        self._blocks[row] = snapshot.blocks[row]
        self._precision[row] = snapshot.precision[row]

    def release(self, row: int, column: int, shift: float, sigma: float, power: float) -> None:
        """Take out what is known of one coefficient, and of the constant, in one row.

        Parameters
        ----------
        row, column : int
            The coefficient.
        shift, sigma : float
            By how much it seems to have changed, and the standard deviation of that.
        power : float
            Information that goes with the shift: integral of the regressor's square.

        Notes
        -----
        A Schur step removes the column's information and leaves that of the others as it is
        with this one unknown; the vector is rebuilt for the coefficient moved by `shift`. The
        scores follow, so that the standard deviations tell what is left. The prior goes too:
        it was knowledge of the aircraft as it was before.
        """
        believed = self.columns.gather(self.solve() - self._start.values)[row]
        matrix, scores = self.matrix[row], self._scores[row]
        for j in np.flatnonzero(self.columns.used[row]):
            regressor = self.columns.index[row, j]
            if regressor == column:
                believed[j] += shift
            if regressor in (column, CONSTANT_COLUMN) and matrix[j, j] > 0.0:
                step = np.eye(len(matrix))
                step[:, j] -= RELEASED_SHARE * matrix[:, j] / matrix[j, j]
                self._precision[row, j] = 0.0
                # The share that is left has the scatter of so few blocks.
                step[j, j] = np.sqrt(1.0 - RELEASED_SHARE)
                scores[:] = step @ scores @ step.T
                matrix -= RELEASED_SHARE * np.outer(matrix[:, j], matrix[j]) / matrix[j, j]
            if regressor == column:
                matrix[j, j] += power
                scores[j, j] += (power * sigma) ** 2
        self.vector[row] = matrix @ believed
        self.sigma = self._compute_sigma()

    def _forget(self, keep: FloatArray) -> None:
        """Let old data count for `keep`, per row; what is quiet is not forgotten.

        ``R <- D R D``, D = sqrt(keep) along what is excited and 1 along what is not; r follows
        so that the solution stays where it is.
        """
        if self._quiet is None or not self._quiet.any():
            self.discount(keep)
            return
        kept = self._quiet[self.columns.index]
        root = np.where(kept, 1.0, np.sqrt(keep)[:, None])
        pairs = root[:, :, None] * root[:, None, :]
        solution = self.columns.gather(self.solve() - self._start.values)[:, :, None]
        before = (self.matrix @ solution)[:, :, 0]
        self.matrix *= pairs
        self.vector += (self.matrix @ solution)[:, :, 0] - before
        self._scores *= pairs**2
        self._blocks *= keep

    def discount(self, weight: float | FloatArray) -> None:
        """Let all that was accumulated count for `weight` of what it did, per row."""
        row = np.broadcast_to(weight, 3)
        self.matrix *= row[:, None, None]
        self.vector *= row[:, None]
        self._scores *= row[:, None, None] ** 2
        self._blocks *= row

    def _system(self) -> FloatArray:
        """Regularised matrix of each row; identity along what is not used, (3, k, k)."""
        matrix = self.matrix.copy()
        diagonal = self._diagonal_of(matrix)
        diagonal += self._precision * self.residual_variance[:, None] + _RIDGE * np.abs(diagonal)
        diagonal[diagonal == 0.0] = 1.0
        return matrix

    def _diagonal_of(self, matrices: FloatArray) -> FloatArray:
        """View of the diagonals, shape (3, k)."""
        k = self.columns.size
        return matrices.reshape(3, k * k)[:, :: k + 1]

    def solve(self) -> FloatArray:
        """Coefficients that satisfy ``R a = r`` with the prior, shape (3, n).

        NaN where the matrix is singular, which the ridge all but excludes.
        """
        try:
            deviation = np.linalg.solve(self._system(), self.vector[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            deviation = np.full_like(self.vector, np.nan)
        return self._start.values + self.columns.scatter(deviation)

    def _correlation(self) -> FloatArray:
        """Information scaled to a unit diagonal, symmetric, shape (3, k, k)."""
        matrix = self._system()
        matrix = 0.5 * (matrix + matrix.transpose(0, 2, 1))
        scale = 1.0 / np.sqrt(np.abs(self._diagonal_of(matrix)))
        return np.asarray(matrix * scale[:, :, None] * scale[:, None, :])

    def excitation(self) -> FloatArray:
        """How well the regressors of each row can be told apart, shape (3,), 0 ... 1.

        The reciprocal of the largest variance inflation factor (Belsley, Kuh and Welsch 1980):
        1 if all regressors are uncorrelated, 0 if one follows from the others. It does not
        depend on their scales.
        """
        inverse = np.linalg.inv(self._correlation())
        inflation = np.abs(self._diagonal_of(inverse)).max(axis=1)
        return np.where(self.time > 0.0, 1.0 / np.maximum(inflation, 1.0), 0.0)

    def collinear(self) -> list[tuple[int, tuple[int, ...]]]:
        """Return the groups of regressors that were not told apart, (row, columns) of each.

        A small eigenvalue of the scaled information is a direction without information; the
        columns with a large share in its eigenvector belong together.
        """
        values, vectors = np.linalg.eigh(self._correlation())
        groups = []
        for i, row in enumerate(vectors):
            for value, vector in zip(values[i], row.T, strict=True):
                shares = (np.abs(vector) > COLLINEAR_SHARE) & self.columns.used[i]
                if value < COLLINEAR_EIGENVALUE and shares.sum() > 1:
                    groups.append((i, tuple(int(j) for j in self.columns.index[i, shares])))
        return groups

    def _compute_sigma(self) -> FloatArray:
        """Return the standard deviations of the coefficients, shape (3, n).

        ``R^-1 S R^-T`` with S the sum of the outer products of the scores of one-second
        blocks: it holds for residuals coloured within a block, where ``s^2 R^-1`` is several
        times too small (block-mean form of Morelli and Klein 1997).
        """
        inverse = np.linalg.inv(self._system())
        # Few blocks: their scatter underestimates; p coefficients cost p degrees of freedom.
        correction = self._blocks / np.maximum(self._blocks - self.columns.counts, 1.0)
        middle = self._scores * correction[:, None, None]
        prior = self._precision * self.residual_variance[:, None] ** 2
        self._diagonal_of(middle)[:] += prior
        covariance = inverse @ middle @ inverse.transpose(0, 2, 1)
        variance = np.maximum(self._diagonal_of(covariance), 0.0)
        return self.columns.scatter(np.sqrt(variance))
