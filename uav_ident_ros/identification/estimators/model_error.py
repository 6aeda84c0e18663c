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

import numpy as np

from uav_ident_ros.identification.regression import Layout, RowSamples
from uav_ident_ros.identification.scales import INDEPENDENT_TIME
from uav_ident_ros.identification.structure import ROWS, BoolArray, FloatArray

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
        self._entries = layout.main
        rows = len(ROWS)
        # samples, their weights (3,) times dt, and whether they do not continue those before
        self._gathered: list[tuple[RowSamples, FloatArray, bool]] = []
        # sum of z f^T, z z^T and z y side by side, and of the squared residuals, a block each
        k = layout.width + EXTRA
        self._blocks: FloatArray = np.zeros((BLOCKS, rows, k, 2 * k + 1))
        self._squares: FloatArray = np.zeros((BLOCKS, rows))
        self._closed = 0
        self._ratio: FloatArray = np.zeros(rows)
        self._time = 0.0
        self._before: FloatArray | None = None
        self._sure: BoolArray = np.zeros((rows, EXTRA), dtype=bool)
        self.share: FloatArray = np.zeros(rows)

    def forget(self, row: int) -> None:
        """Forget what a row has shown: it is learned anew."""
        self._blocks[:, row] = self._squares[:, row] = self.share[row] = 0.0
        for _, weight, _ in self._gathered:
            weight[row] = 0.0
        self._sure[row] = False

    def add(
        self, samples: RowSamples, weight: FloatArray, ratio: FloatArray, *, restarted: bool
    ) -> None:
        """Take samples; they are looked at in blocks of `INDEPENDENT_TIME`.

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
        self._gathered.append((samples, samples.dt * weight, restarted))
        self._time += samples.time
        if self._time >= INDEPENDENT_TIME - 0.5 * samples.dt:
            self._time = 0.0
            self._ratio = ratio[range(len(ROWS)), self._entries]
            self._close_block()
            self._look()

    def _close_block(self) -> None:
        """Add up what was gathered."""
        gathered, self._gathered = self._gathered, []
        signals = np.concatenate([part.signals[: len(ROWS)] for part, _, _ in gathered], axis=1)
        counts = [part.count for part, _, _ in gathered]
        weight = np.repeat([weight for _, weight, _ in gathered], counts, axis=0).T
        step = np.repeat([part.dt for part, _, _ in gathered], counts)
        k = gathered[0][0].width
        # Both inputs, as regressor and as instrument; a restart's first has no slope.
        places = np.array([[2 + entry, 2 + k + entry] for entry in self._entries])
        u = np.take_along_axis(signals, places[:, None], axis=2)
        first = u[:, :1] if self._before is None else self._before
        slope = np.diff(np.concatenate((first, u), axis=1), axis=1) / step[:, None]
        restarted = [begins for _, _, begins in gathered]
        slope[:, np.cumsum([0, *counts[:-1]])[restarted]] = 0.0
        self._before = u[:, -1:]
        extra = np.stack((u * np.abs(u), slope), axis=-1)  # (3, m, of f or z, EXTRA)
        y, f, z = signals[:, :, 1:2], signals[:, :, 2 : 2 + k], signals[:, :, 2 + k :]
        f, z = (np.concatenate((part, extra[:, :, i]), axis=2) for i, part in enumerate((f, z)))
        weighted = (z * weight[:, :, None]).transpose(0, 2, 1)
        newest = self._closed % BLOCKS
        self._blocks[newest] = weighted @ np.concatenate((f, z, y), axis=2)
        self._squares[newest] = np.add.reduce(weight * signals[:, :, 0] ** 2, axis=1)
        self._closed += 1

    def _look(self) -> None:
        """Solve in units of each regressor's rms, and compare the extra ones with their sigma."""
        k, blocks = self._blocks.shape[2], self._blocks[: self._closed]
        if len(blocks) <= k:
            return  # as many coefficients leave no scatter to judge by
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
        answers = self._ratio * np.add.reduce(self._squares)
        variance[:, -1] += answers * np.einsum(
            "ij,ijk,ik->i", gain[:, -1], instruments, gain[:, -1]
        )
        extra, effect = linear[:, -EXTRA:], linear[range(len(ROWS)), self._entries, None]
        away = np.divide(-extra, effect, out=np.zeros_like(extra), where=effect != 0.0)
        least = np.where(self._sure, ACQUITTED_T, LEAST_T)
        self._sure = extra**2 > least**2 * variance
        self.share = np.where(self._sure, np.maximum(away, 0.0), 0.0).max(axis=1)
