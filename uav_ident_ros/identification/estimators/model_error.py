# SPDX-License-Identifier: Apache-2.0
"""What a surface does otherwise than the model says: late, or less the more is asked of it.

A servo lag or a limit of travel that nobody told leaves little in the residual: damping takes up
most of it. So they are looked for beside all other regressors of a row, in a regression of its own,

    y = A f + c1 u|u| + c2 du/dt,

with u the row's main input (a model error model; Ljung, System Identification, 1999, ch. 16). Where
c1 takes away from what the input does, it saturates; where c2 does, it acts late. Then the control
derivative is off by about as much.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from uav_ident_ros.identification.regression import Layout
from uav_ident_ros.identification.row_samples import RowSamples
from uav_ident_ros.identification.structure import MAIN_COLUMNS, ROWS, BoolArray, FloatArray

BLOCK_TIME = 1.0
"""Length of the blocks whose scores are taken as independent, s; a look after each."""

BLOCKS = 60
"""Blocks that are looked at, the newest: a minute."""

LEAST_T = 4.0
"""Value over sigma from which it is no chance: one look in ten thousand."""

ACQUITTED_T = 2.0
"""Value over sigma below which what was found is taken back: between the two no look is new."""

LOADING = 1e-4
"""Added to the information, relative to its diagonal: the input and its square are alike."""

EXTRA = 2
"""Regressors that are added."""


class ModelError:
    """Follows what the main input of each moment row does otherwise than the model says.

    Parameters
    ----------
    layout : Layout
        The regression problem.

    Attributes
    ----------
    share : (3,) array
        What is taken away by lateness or saturation, whichever is more, relative to what the input
        does, both in rms; 0 where it is no more than chance.
    """

    def __init__(self, layout: Layout) -> None:
        self._entries = [layout.index[i].tolist().index(j) for i, j in enumerate(MAIN_COLUMNS)]
        rows, k = len(ROWS), layout.width + EXTRA
        # sum of z f^T, z z^T and z y side by side, (rows, k, 2 k + 1), a block each
        self._sums: FloatArray = np.zeros((rows, k, 2 * k + 1))
        self._blocks: deque[FloatArray] = deque(maxlen=BLOCKS)
        self._squares: deque[FloatArray] = deque(maxlen=BLOCKS)  # of the residuals, (rows,)
        self._square: FloatArray = np.zeros(rows)
        self._ratio: FloatArray = np.zeros(rows)
        self._time = 0.0
        self._before: list[FloatArray] = []
        self._sure: BoolArray = np.zeros((rows, EXTRA), dtype=bool)
        self.share: FloatArray = np.zeros(rows)

    def forget(self, row: int) -> None:
        """Forget what a row has shown: it is learned anew."""
        for part in (*self._blocks, *self._squares, self._sums, self._square, self.share):
            part[row] = 0.0
        self._sure[row] = False

    def add(
        self, samples: RowSamples, weight: FloatArray, ratio: FloatArray, *, restarted: bool
    ) -> None:
        """Take samples.

        Parameters
        ----------
        samples : RowSamples
            The samples.
        weight : (3,) array
            How much they count in each row.
        ratio : (3, k) array
            q of the instruments as `Feedback` has it: an input that answers looks late.
        restarted : bool
            Whether the first does not continue those before.
        """
        parts = [samples.f[: len(ROWS)], samples.z[: len(ROWS)]]
        inputs = [part[range(len(ROWS)), :, self._entries] for part in parts]
        before = [u[:, :1] for u in inputs] if restarted or not self._before else self._before
        f, z = (
            self._with_extra(part, u, first, samples.dt)
            for part, u, first in zip(parts, inputs, before, strict=True)
        )
        self._before = [u[:, -1:] for u in inputs]
        y = samples.y[: len(ROWS), :, None]
        weighted = (z * (samples.dt * weight)[:, None, None]).transpose(0, 2, 1)
        self._sums += weighted @ np.concatenate((f, z, y), axis=2)
        square = np.add.reduce(samples.residual[: len(ROWS)] ** 2, axis=1)
        self._square = self._square + samples.dt * weight * square
        self._ratio = ratio[range(len(ROWS)), self._entries]
        self._time += samples.time
        if self._time >= BLOCK_TIME - 0.5 * samples.dt:
            self._blocks.append(self._sums)
            self._squares.append(self._square)
            self._sums, self._square = np.zeros_like(self._sums), np.zeros_like(self._square)
            self._time = 0.0
            self._look()

    @staticmethod
    def _with_extra(part: FloatArray, u: FloatArray, before: FloatArray, dt: float) -> FloatArray:
        """Regressors (3, m, k) with those behind them that are made of the inputs u (3, m)."""
        slope = np.diff(np.concatenate((before, u), axis=1), axis=1) / dt
        return np.concatenate((part, (u * np.abs(u))[:, :, None], slope[:, :, None]), axis=2)

    def _look(self) -> None:
        """Solve in units of each regressor's rms, and compare the extra ones with their sigma."""
        k = self._sums.shape[1]
        if len(self._blocks) <= k:
            return  # as many coefficients leave no scatter to judge by
        blocks = np.array(self._blocks)
        total = np.add.reduce(blocks)
        zf, zz, zy = total[..., :k], total[..., k:-1], total[..., -1]
        power = np.einsum("ijj->ij", zz)
        scale = 1.0 / np.sqrt(np.where(power > 0.0, power, 1.0))
        both = scale[:, :, None] * scale[:, None, :]
        load = LOADING * np.eye(k)
        slope, instruments = zf * both, zz * both + load
        projected = np.linalg.solve(instruments, slope).transpose(0, 2, 1)
        gain = np.linalg.solve(projected @ slope + load, projected)
        linear = (gain @ (scale * zy)[:, :, None])[:, :, 0]
        # A block's score, sum of z e, is linear in the coefficients.
        scores = blocks[..., -1] - (blocks[..., :k] @ (linear * scale)[:, :, None])[..., 0]
        scatter = np.einsum("bij,ilj->bil", scores * scale, gain[:, -EXTRA:])
        lost = k / (len(blocks) - k)
        variance = (1.0 + lost) * np.add.reduce(scatter**2)
        # An input that answers looks late, but not as if it stopped short.
        answers = self._ratio * np.add.reduce(np.array(self._squares))
        variance[:, -1] += answers * np.einsum(
            "ij,ijk,ik->i", gain[:, -1], instruments, gain[:, -1]
        )
        extra, effect = linear[:, -EXTRA:], linear[range(len(ROWS)), self._entries, None]
        away = np.divide(-extra, effect, out=np.zeros_like(extra), where=effect != 0.0)
        least = np.where(self._sure, ACQUITTED_T, LEAST_T)
        self._sure = extra**2 > least**2 * variance
        self.share = np.where(self._sure, np.maximum(away, 0.0), 0.0).max(axis=1)
