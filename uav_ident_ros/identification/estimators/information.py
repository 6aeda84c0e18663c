# SPDX-License-Identifier: Apache-2.0
"""Accumulated information, and the coefficients and standard deviations that follow from it.

For each row ``R = sum z f^T``, ``S = sum z z^T``, ``r = sum z y``. With ``z = f`` the solution of
``R a = r`` is least squares, with ``z`` the regressors of the model's own state it is the
instrumental variable. Both are the law ``Am_dot = e f^T K`` with a gain that is computed, not
chosen. Solved is the projected form with a prior (two-stage least squares),

    a = (R^T S^-1 R + P)^-1 R^T S^-1 r,

which is R^-1 r where the instruments are strong, and goes to the prior where they are weak.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Layout
from uav_ident_ros.identification.row_samples import RowSamples
from uav_ident_ros.identification.structure import (
    BoolArray,
    FloatArray,
    FlowRows,
    Structure,
)

BLOCK_TIME = 1.0
"""Length of the blocks whose scores are taken as independent, s: longer than the correlation
of gusts and filter."""

RESIDUAL_TIME = 10.0
"""Memory of the running residual variance, s; it weighs the prior alone."""

LARGEST_OUTLIER = 9.0
"""Squared residual, relative to its variance, that still counts in full: three sigma."""

FIRST_RESIDUAL_VARIANCE = 0.1
"""Residual variance until there is a measured one, rad^2/s^4: filtered gyro noise."""

RIDGE = 1e-9
"""Relative to an instrument's own power: keeps the projection defined where instruments are
collinear; a hundred times above rounding."""

MODEL_ERROR = 0.03
"""Error of a coefficient, relative to its value, that no residual shows: one number stands for an
aircraft over a range of speeds and angles. After excited flights of five aircraft in calm air the
control derivatives are off by 2.4 % rms, all dominant ones by 3.4 (benchmarks/derivatives.py)."""

KNOWN_BLOCKS = 1000.0
"""Blocks that what is known counts as: its covariance owes nothing to the scatter of a few."""

COLLINEAR_EIGENVALUE = 0.02
"""Eigenvalue of the scaled information below which its direction is unknown; 1 if all
regressors are uncorrelated."""

COLLINEAR_SHARE = 0.4
"""Component of the eigenvector from which a regressor belongs to the group."""


@dataclass
class Sums:
    """What was accumulated, a row of the regression problem an entry.

    Parameters
    ----------
    zf, zz : (rows, k, k) array
        ``R = sum z f^T``, ``S = sum z z^T``, both times dt.
    zy : (rows, k) array
        ``r = sum z y``, times dt.
    scores : (rows, k, k) array
        Sum of ``g g^T`` over blocks, ``g`` the sum of ``z e`` over a block, times dt.
    blocks : (rows,) array
        Number of blocks.
    answers : (rows, k, k) array
        Sum of ``q z z^T`` times dt, q as `Feedback` has it: what answers disturbances.
    answer_time : (rows,) array
        Time with answers, s.
    """

    zf: FloatArray
    zz: FloatArray
    zy: FloatArray
    scores: FloatArray
    blocks: FloatArray
    answers: FloatArray
    answer_time: FloatArray

    @classmethod
    def nothing(cls, rows: int, k: int) -> Self:
        """Return sums of nothing."""
        square = (rows, k, k)
        zf, zz, scores, answers = (np.zeros(square) for _ in range(4))
        return cls(zf, zz, np.zeros((rows, k)), scores, np.zeros(rows), answers, np.zeros(rows))

    def nothing_alike(self) -> Sums:
        """Return sums of nothing, of the same shape."""
        return self.nothing(*self.zy.shape)

    def copy(self) -> Sums:
        """Return an independent copy."""
        return Sums(*(getattr(self, field.name).copy() for field in fields(self)))

    def plus(self, other: Sums) -> Sums:
        """Return the sums of both."""
        return Sums(
            *(getattr(self, field.name) + getattr(other, field.name) for field in fields(self))
        )

    def add(self, samples: RowSamples, weight: FloatArray, ratio: FloatArray | None = None) -> None:
        """Add samples, which count for `weight` (rows,) in each row.

        Parameters
        ----------
        samples : RowSamples
            The samples.
        weight : (rows,) array
            Their weight.
        ratio : (rows, k) array, optional
            q of each instrument as `Feedback` has it; nothing answers a disturbance without it.
        """
        weighted = (samples.z * (samples.dt * weight)[:, None, None]).transpose(0, 2, 1)
        zz = weighted @ samples.z
        self.zf += weighted @ samples.f
        self.zz += zz
        self.zy += (weighted @ samples.y[:, :, None])[:, :, 0]
        if ratio is not None and ratio.any():
            root = np.sqrt(ratio)
            self.answers += zz * root[:, :, None] * root[:, None, :]
            self.answer_time += samples.time * weight * (ratio > 0.0).any(axis=1)

    def weigh(self, keep: FloatArray) -> None:
        """Let all samples so far count for `keep` (rows,) of what they did."""
        row = keep[:, None, None]
        self.zf *= row
        self.zz *= row
        self.zy *= keep[:, None]
        self.scores *= row * row
        self.blocks *= keep
        self.answers *= row
        self.answer_time *= keep

    def discount(self, keep: FloatArray) -> None:
        """Let what they tell be worth `keep` (rows,) of what it was: sigma grows."""
        self.weigh(keep)
        self.scores /= np.maximum(keep, np.finfo(float).tiny)[:, None, None]

    def set_row(self, row: int, other: Sums) -> None:
        """Take one row from other sums."""
        for field in fields(self):
            getattr(self, field.name)[row] = getattr(other, field.name)[row]

    def set_known(
        self, row: int, mean: FloatArray, covariance: FloatArray, free: BoolArray, unit: float
    ) -> None:
        """Let one row hold just this: a covariance reset.

        Parameters
        ----------
        row : int
            The row.
        mean : (k,) array
            Coefficients.
        covariance : (k, k) array
            Their covariance.
        free : (k,) bool array
            Those that it is about.
        unit : float
            Residual variance times its correlation time, by which information counts.
        """
        pairs = np.ix_(free, free)
        precision = np.zeros_like(covariance)
        precision[pairs] = np.linalg.inv(covariance[pairs])
        self.zf[row] = self.zz[row] = unit * precision
        self.zy[row] = self.zf[row] @ mean
        self.scores[row] = unit**2 * precision
        self.blocks[row] = KNOWN_BLOCKS
        self.answers[row] = self.answer_time[row] = 0.0


@dataclass(frozen=True)
class Solution:
    """Coefficients, and how well they are known.

    Parameters
    ----------
    linear : (rows, k) array
        Coefficients of the regression problem.
    covariance : (rows, k, k) array
        Their covariance, row by row.
    values, sigma : (R, n) array
        Coefficients of the structure, and their standard deviations.
    """

    linear: FloatArray
    covariance: FloatArray
    values: FloatArray
    sigma: FloatArray


class Information:
    """What the samples so far tell, with prior and forgetting.

    Parameters
    ----------
    structure : Structure
        Structure of the coefficients.
    layout : Layout
        Its regression problem.
    start : Start
        Initial coefficients, their uncertainty, and which are free.
    correlation_time : float
        Time over which residuals are correlated, s: that of the regression's filter.
    forgetting_time : float
        Time constant of forgetting, s; 0 for never.

    Attributes
    ----------
    forgetting_time : float
        The parameter; it may change at any time.
    sums : Sums
        What was accumulated.
    variance : (rows,) array
        Running residual variance.
    time : (rows,) array
        How long each row has learned, s.
    """

    def __init__(
        self,
        structure: Structure,
        layout: Layout,
        start: Start,
        correlation_time: float,
        forgetting_time: float = 0.0,
    ) -> None:
        self.layout = layout
        self.forgetting_time = forgetting_time
        self._structure = structure
        self._unit_time = correlation_time
        rows, k = layout.rows, layout.width
        self._i, self._j = layout.place[..., 0], layout.place[..., 1]
        self._flow = _flow_entries(structure, layout)
        self._kinematic = _kinematic_entries(structure, layout)
        self.start = start
        self.sums = Sums.nothing(rows, k)
        self.variance: FloatArray = np.full(rows, FIRST_RESIDUAL_VARIANCE)
        self.time: FloatArray = np.zeros(rows)
        self._score: FloatArray = np.zeros((rows, k))
        self._score_time: FloatArray = np.zeros(rows)

    @property
    def start(self) -> Start:
        """Initial coefficients, their uncertainty, and which are free."""
        return self._start

    @start.setter
    def start(self, start: Start) -> None:
        self._start = start
        used = self.layout.used
        self._initial = np.where(used, start.values[self._i, self._j], 0.0)
        self.free: BoolArray = used & start.free[self._i, self._j]
        self._precision = np.where(self.free, start.precision[self._i, self._j], 0.0)
        self._told = used & start.told(self._structure)[self._i, self._j]
        self._pairs = self.free[:, :, None] & self.free[:, None, :]
        self._rest = np.where(self.free, 0.0, 1.0)

    @property
    def unit(self) -> FloatArray:
        """Residual variance times its correlation time: the unit of information, (rows,)."""
        return self.variance * self._unit_time

    def add(self, samples: RowSamples, weight: FloatArray, ratio: FloatArray | None = None) -> None:
        """Add samples as `Sums.add` does; in a row of weight 0 all stays as it is."""
        m = samples.y.shape[1]
        if not m:
            return
        self.sums.add(samples, weight, ratio)
        known, dt = self.time > 0.0, weight * samples.time
        # What coefficients that know nothing leave is no residual.
        residual = np.where(known[:, None], samples.residual, 0.0)
        square = np.minimum(residual * residual, LARGEST_OUTLIER * self.variance[:, None])
        share = np.minimum(dt / np.minimum(RESIDUAL_TIME, self.time + BLOCK_TIME), 1.0)
        self.variance += known * share * (np.add.reduce(square, axis=1) / m - self.variance)
        self.time += dt
        self._score += (weight * samples.dt)[:, None] * (residual[:, None] @ samples.z)[:, 0]
        self._score_time += dt
        if max(self._score_time.tolist()) >= BLOCK_TIME:
            self._close_blocks(self._score_time >= BLOCK_TIME)

    def _close_blocks(self, full: BoolArray) -> None:
        """Count the scores of the rows whose block is full, and forget."""
        score = np.where(full[:, None], self._score, 0.0)
        self.sums.scores += score[:, :, None] * score[:, None, :]
        self.sums.blocks += full
        if self.forgetting_time > 0.0:
            spent = np.where(full, self._score_time, 0.0)
            self.sums.weigh(np.exp(-spent / self.forgetting_time))
        self._score[full] = 0.0
        self._score_time[full] = 0.0

    def discount(self, keep: float) -> None:
        """Let all that was accumulated be worth `keep` of what it was."""
        self.sums.discount(np.full(self.layout.rows, keep))

    # -- solution --------------------------------------------------------------------------

    def solve(self, values: FloatArray, extra: Sums | None = None) -> Solution:
        """Return the coefficients and their standard deviations.

        Parameters
        ----------
        values : (R, n) array
            The coefficients before: their force rows turn forces into flow angles.
        extra : Sums, optional
            More that is known.
        """
        sums = self.sums if extra is None else self.sums.plus(extra)
        transform = self._transform(values)
        prior = self._prior(sums)
        projected, system = self._system(sums, transform, prior)
        target = sums.zy[:, :, None] - sums.zf @ (transform @ self._initial[:, :, None])
        try:
            inverse = np.linalg.inv(system)
        except np.linalg.LinAlgError:
            inverse = np.full_like(system, np.nan)
        gain = np.where(self._pairs, inverse @ projected, 0.0)
        physical = self._initial + (gain @ target)[:, :, 0]
        covariance = self._covariance(sums, inverse, gain, prior)
        linear = (transform @ physical[:, :, None])[:, :, 0]
        return Solution(
            linear,
            transform @ covariance @ transform.transpose(0, 2, 1),
            self._place(physical, self._start.values),
            self._sigma(covariance, linear, 1.0 - np.einsum("ijj->ij", inverse) * prior),
        )

    def _system(
        self, sums: Sums, transform: FloatArray, prior: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return ``B^T S^-1`` and ``B^T S^-1 B + P``, with B = R T; both (rows, k, k)."""
        instruments = np.where(self._pairs, sums.zz, 0.0)
        power = np.einsum("ijj->ij", instruments)
        scale = 1.0 / np.sqrt(np.where(power > 0.0, power, 1.0))
        scaled = instruments * scale[:, :, None] * scale[:, None, :]
        np.einsum("ijj->ij", scaled)[...] += RIDGE + (power <= 0.0)
        slope = np.where(self._pairs, sums.zf @ transform, 0.0) * scale[:, :, None]
        projected = np.linalg.solve(scaled, slope).transpose(0, 2, 1)
        system = projected @ slope
        diagonal = np.einsum("ijj->ij", system)
        diagonal += prior + self._rest
        # Columns without power have neither data nor, where fixed, a prior.
        diagonal[diagonal <= 0.0] = 1.0
        return projected * scale[:, None, :], system

    def _prior(self, sums: Sums) -> FloatArray:
        """Return how much the prior counts, (rows, k), where samples count as their time.

        What answers disturbances is as good as a few samples, however long it lasts: beside it
        what was learned before counts for more. What only keeps noise out does not.
        """
        power, answers = (np.einsum("ijj->ij", part) for part in (sums.zz, sums.answers))
        share = np.divide(answers, power, out=np.zeros_like(power), where=power > 0.0)
        longer = 1.0 + self._told * share * (sums.answer_time / self._unit_time)[:, None]
        return np.asarray(self._precision * self.unit[:, None] * longer)

    def _covariance(
        self, sums: Sums, inverse: FloatArray, gain: FloatArray, prior: FloatArray
    ) -> FloatArray:
        """Return the covariance of the coefficients, shape (rows, k, k).

        ``G Omega G^T`` with Omega the sum of the outer products of the scores of one-second
        blocks: it holds for residuals coloured within a block, where ``s^2 R^-1`` is several
        times too small (block-mean form of Morelli and Klein 1997), and what answers disturbances
        in full (`Feedback`). The prior adds its own part.
        """
        # Few blocks: their scatter underestimates; p coefficients cost p degrees of freedom.
        lost = self.free.sum(axis=1)
        correction = 1.0 + lost / np.maximum(sums.blocks - lost, 1.0)
        middle = sums.scores * correction[:, None, None]
        middle += (self.variance * sums.answer_time)[:, None, None] * sums.answers
        held = np.divide(
            prior**2, self._precision,
            out=np.zeros_like(self._precision), where=self.free,
        )  # fmt: skip
        return np.asarray(
            gain @ middle @ gain.transpose(0, 2, 1)
            + (inverse * held[:, None, :]) @ inverse.transpose(0, 2, 1)
        )

    def _transform(self, values: FloatArray) -> FloatArray:
        """Matrices T from the structure's coefficients to the linear ones, (rows, k, k)."""
        rows, k = self.layout.rows, self.layout.width
        transform = np.broadcast_to(np.eye(k), (rows, k, k)).copy()
        for at in self._flow:
            force = values[at.rows.force]
            transform[at.row, at.angle, at.angle] = 1.0 / force[at.rows.angle]
            for entry, column in at.others:
                transform[at.row, entry, at.angle] = -force[column] / force[at.rows.angle]
        for at_rows, entry in self._kinematic:
            transform[at_rows.force, entry, entry] = values[at_rows.force, at_rows.angle]
        return transform

    def _sigma(
        self, covariance: FloatArray, linear: FloatArray, resolution: FloatArray
    ) -> FloatArray:
        """Return the standard deviations of the structure's coefficients, shape (R, n).

        What is not free keeps that of the start. Where a flow angle is used, the uncertainty of
        the force row that defines it adds to that of the moment, as far as the samples tell of it:
        the `resolution` (rows, k), 1 without a prior.
        """
        variance = np.maximum(np.einsum("ijj->ij", covariance), 0.0)
        out = self._place(variance, np.zeros_like(self._start.values))
        for at in self._flow:
            share, force = linear[at.row, at.angle] ** 2, out[at.rows.force]
            for entry, column in ((at.angle, at.rows.angle), *at.others):
                out[at.row, column] += share * force[column] * resolution[at.row, entry] ** 2
        return np.where(self._start.free, np.sqrt(out), self._start.sigma)

    def _place(self, entries: FloatArray, out: FloatArray) -> FloatArray:
        """Entries of the rows (rows, k) at their places in the structure, over `out` (R, n)."""
        out = out.copy()
        used = self.layout.used
        out[self._i[used], self._j[used]] = entries[used]
        return out

    # -- what the flight has told ----------------------------------------------------------

    def _correlation(self) -> FloatArray:
        """Information of the moment rows, scaled to a unit diagonal, symmetric, (3, k, k)."""
        matrix = np.where(self._pairs, self.sums.zf, 0.0)[:3]
        matrix = 0.5 * (matrix + matrix.transpose(0, 2, 1))
        diagonal = np.einsum("ijj->ij", matrix)
        diagonal += (self._precision * self.unit[:, None] + self._rest)[:3]
        scale = 1.0 / np.sqrt(np.abs(diagonal))
        return np.asarray(matrix * scale[:, :, None] * scale[:, None, :])

    def excitation(self) -> FloatArray:
        """How well the regressors of each moment row can be told apart, shape (3,), 0 ... 1.

        The reciprocal of the largest variance inflation factor (Belsley, Kuh and Welsch 1980):
        1 if all regressors are uncorrelated, 0 if one follows from the others. It does not
        depend on their scales.
        """
        inverse = np.linalg.inv(self._correlation())
        inflation = np.abs(np.einsum("ijj->ij", inverse)).max(axis=1)
        return np.where(self.time[:3] > 0.0, 1.0 / np.maximum(inflation, 1.0), 0.0)

    def collinear(self) -> list[tuple[int, tuple[int, ...]]]:
        """Return the groups of regressors that were not told apart, (row, columns) of each.

        A small eigenvalue of the scaled information is a direction without information; the
        columns with a large share in its eigenvector belong together.
        """
        values, vectors = np.linalg.eigh(self._correlation())
        groups = []
        for i, row in enumerate(vectors):
            for value, vector in zip(values[i], row.T, strict=True):
                shares = (np.abs(vector) > COLLINEAR_SHARE) & self.free[i]
                if value < COLLINEAR_EIGENVALUE and shares.sum() > 1:
                    groups.append((i, tuple(int(j) for j in self._j[i, shares])))
        return groups

    def correlations(self) -> list[tuple[tuple[int, ...], FloatArray]]:
        """Return how the estimates of each moment row depend on one another.

        Its free columns (m,), and the correlation of their estimates (m, m), 1 on the diagonal.
        """
        found = []
        for i, inverse in enumerate(np.linalg.inv(self._correlation())):
            places = np.flatnonzero(self.free[i])
            covariance = inverse[np.ix_(places, places)]
            scale = 1.0 / np.sqrt(np.abs(np.diag(covariance)))
            columns = tuple(int(j) for j in self._j[i, places])
            found.append((columns, covariance * np.outer(scale, scale)))
        return found


@dataclass(frozen=True)
class FlowEntries:
    """Where a flow angle stands in a moment row of the regression problem.

    Parameters
    ----------
    row, angle : int
        Row, and entry of the angle.
    others : tuple of (int, int)
        Entry of each thing that adds to the angle's force, and its column in the structure.
    rows : FlowRows
        Where the angle stands in the structure.
    """

    row: int
    angle: int
    others: tuple[tuple[int, int], ...]
    rows: FlowRows


def _flow_entries(structure: Structure, layout: Layout) -> list[FlowEntries]:
    """Return where flow angles stand in the moment rows."""
    places = []
    for rows in structure.flow:
        for row in range(3):
            columns = layout.index[row][layout.used[row]].tolist()
            if rows.angle in columns:
                others = [(columns.index(j), j) for j in rows.others if j in columns]
                places.append(FlowEntries(row, columns.index(rows.angle), tuple(others), rows))
    return places


def _kinematic_entries(structure: Structure, layout: Layout) -> list[tuple[FlowRows, int]]:
    """Entries of the force rows that are about what the kinematics miss."""
    return [
        (rows, entry)
        for rows in structure.flow
        for entry in np.flatnonzero(layout.used[rows.force]).tolist()
        if layout.place[rows.force, entry, 0] == rows.kinematics
    ]
