# SPDX-License-Identifier: Apache-2.0
"""What flights show that the model has no term for: lateness, saturation, an Imu beside the centre.

A servo lag or a limit of travel that nobody told leaves little in the residual: damping takes up
most of it. So they are looked for beside all other regressors of a row, in a regression of its own,

    y = A f + c1 u|u| + c2 du/dt - c3 d2u/dt2,

with u the row's main input (a model error model; Ljung, System Identification, 1999, ch. 16). Where
c1 takes away from what the input does, it saturates; where c2 does, it acts late; where c3 does, it
does less the quicker it moves, as with a servo lag for which a delay stands. Then the control
derivative is off by about as much. Where c2 adds to it, it acts early: a lag or a delay was told
that is not there, and all derivatives may be off by several times.

An accelerometer h above the centre of gravity measures `h pdot` as side force. In the row of ay,
with p in the place of u, c2 is h.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from uav_ident_ros.identification.regression import Layout, RowSamples
from uav_ident_ros.identification.scales import BLOCKS, DOUBTLESS, INDEPENDENT_TIME
from uav_ident_ros.identification.structure import ROWS, BoolArray, FloatArray

ACQUITTED = 0.5 * DOUBTLESS
"""Value over sigma below which what was found is taken back: between the two no look is new."""

LOADING = 1e-4
"""Added to the information, relative to its diagonal: the input and its square are alike."""

EXTRA = 3
"""Regressors that are added.

The first and the last are looked for one at a time: all three need longer than a cold start has.
"""

_SATURATION, _LATENESS, _ATTENUATION = range(EXTRA)


class ModelError:
    """Follows what the main input of each moment row does otherwise than the model says.

    Parameters
    ----------
    layout : Layout
        The regression problem.

    Attributes
    ----------
    share : (3,) array
        What is taken away by saturation, lateness or attenuation, whichever is most, relative to
        what the input does, both in rms; 0 where it is no more than chance.
    height : float
        Of the accelerometer above where it is said to be, m; 0 where it is no more than chance.
    """

    def __init__(self, layout: Layout) -> None:
        self._entries = [*layout.main, *layout.rolling]
        # samples, and their weights (3,) times dt
        self._gathered: list[tuple[RowSamples, FloatArray]] = []
        # of each block, the sum of z f^T, z z^T and z y side by side, and of the squared residuals
        self._blocks: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=BLOCKS)
        self._settled = 0  # of these, the newest, whose instruments a known model made
        # What was found and is not taken back yet: of all blocks saturation and lateness, and
        # attenuation and lateness; of the newest saturation and lateness
        self._sure: BoolArray = np.zeros((3, len(self._entries), 2), dtype=bool)
        self.share: FloatArray = np.zeros(len(ROWS))
        self._early = 0.0
        self.height = 0.0

    @property
    def doubt(self) -> FloatArray:
        """The same, (3,), or what comes early in any row, if that is more.

        Delay and lag are one setting for all inputs, and nothing but they makes one look early.
        """
        return np.maximum(self.share, self._early)

    def forget(self, row: int) -> None:
        """Forget what a row has shown: it is learned anew."""
        self._gathered.clear()
        for products, squares in self._blocks:
            products[row] = squares[row] = 0.0
        self._sure[:, row], self.share[row] = False, 0.0

    def add(
        self,
        samples: RowSamples,
        weight: FloatArray,
        ratio: FloatArray,
        roll_ratio: float,
        effect: FloatArray,
        *,
        restarted: bool,
        settled: bool = True,
    ) -> None:
        """Take samples; they are looked at in blocks of `INDEPENDENT_TIME`.

        Parameters
        ----------
        samples : RowSamples
            The samples.
        weight : (3,) array
            How much they count in each row.
        ratio : (3,) array
            q of each row's main input as `Feedback` has it: one that answers looks late.
        roll_ratio : float
            The same of what rolls the aircraft: the gust that it answers pushes sideways, too.
        effect : (3,) array
            Control derivative of each row's main input.
        restarted : bool
            Whether the first does not continue those before.
        settled : bool
            Whether the model that makes the instruments is known. At the start it leaks, and gusts
            are in them; as soon as there are blocks enough without, those of the start go.
        """
        if restarted or not weight.any():
            self._gathered.clear()
        if not weight.any():
            return
        self._gathered.append((samples, samples.dt * weight))
        if sum(part.time for part, _ in self._gathered) >= INDEPENDENT_TIME - 0.5 * samples.dt:
            self._close_block()
            self._settled += settled
            self._look(np.append(ratio, roll_ratio)[: len(self._entries)], effect)

    def _close_block(self) -> None:
        """Add up what was gathered."""
        parts, weights = zip(*self._gathered, strict=True)
        self._gathered.clear()
        samples = RowSamples.join(parts, sum(part.count for part in parts))
        rows = slice(len(self._entries))
        weight = np.repeat(weights, [part.count for part in parts], axis=0).T
        weight = weight[[0, 1, 2, 0][rows]]  # a roll tells the row of ay
        weight[:, 0] = 0.0  # its slope is not known
        f, z = (self._extended(part[rows], samples.dt) for part in (samples.f, samples.z))
        weighted = (z * weight[:, :, None]).transpose(0, 2, 1)
        products = weighted @ np.concatenate((f, z, samples.y[rows, :, None]), axis=2)
        squares = np.add.reduce(weight * samples.residual[rows] ** 2, axis=1)
        self._blocks.append((products, squares))

    def _extended(self, regressors: FloatArray, dt: float) -> FloatArray:
        """Regressors (rows, m, k), or instruments, with those added that each row's u makes."""
        u = regressors[range(len(self._entries)), :, self._entries]
        extended = np.zeros((*u.shape, regressors.shape[-1] + EXTRA))
        extended[..., :-EXTRA] = regressors
        extra = extended[..., -EXTRA:]
        extra[..., _SATURATION] = u * np.abs(u)
        extra[:, 1:, _LATENESS] = (u[:, 1:] - u[:, :-1]) / dt
        extra[:, 1:-1, _ATTENUATION] = (2.0 * u[:, 1:-1] - u[:, 2:] - u[:, :-2]) / dt**2
        return extended

    def _look(self, ratio: FloatArray, effect: FloatArray) -> None:
        """Look at all blocks, and for what comes early at those after the start, if enough.

        A model that leaks lets gusts into the instruments, which the inputs then seem to foretell.
        """
        blocks, squares = (np.array(part) for part in zip(*self._blocks, strict=True))
        k = blocks.shape[2] - EXTRA + 2
        if len(blocks) <= k:
            return  # as many coefficients leave no scatter to judge by
        found, size = self._found(blocks, squares, _SATURATION, self._sure[0], ratio, effect)
        slow, _ = self._found(blocks, squares, _ATTENUATION, self._sure[1], ratio, effect)
        self.height = float(size[len(ROWS) :, 1].sum())
        taken = np.column_stack((found, slow[:, 0]))[: len(ROWS)]
        self.share = np.maximum(taken, 0.0).max(axis=1)
        if self._settled > k:
            blocks, squares = (part[-self._settled :] for part in (blocks, squares))
            found, _ = self._found(blocks, squares, _SATURATION, self._sure[2], ratio, effect)
        self._early = -found[: len(ROWS), 1].min(initial=0.0)

    def _found(
        self,
        blocks: FloatArray,
        squares: FloatArray,
        other: int,
        sure: BoolArray,
        ratio: FloatArray,
        effect: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return what an extra regressor and lateness take away, and their coefficients.

        Both are (rows, 2), 0 where that may be chance. Solved in units of each regressor's rms;
        they are compared with their own sigma, and `sure` (rows, 2) follows.
        """
        width = blocks.shape[2]
        kept = [*range(width - EXTRA), width - EXTRA + other, width - EXTRA + _LATENESS]
        k = len(kept)
        total = np.add.reduce(blocks)[:, kept]
        zf, zz, zy = total[..., kept], total[..., width:-1][..., kept], total[..., -1]
        power = np.einsum("ijj->ij", zz)
        scale = 1.0 / np.sqrt(np.where(power > 0.0, power, 1.0))
        both = scale[:, :, None] * scale[:, None, :]
        load = LOADING * np.eye(k)
        slope, instruments = zf * both, zz * both + load
        projected = np.linalg.solve(instruments, slope).transpose(0, 2, 1)
        gain = np.linalg.solve(projected @ slope + load, projected)
        linear = (gain @ (scale * zy)[:, :, None])[:, :, 0]
        # A block's score, sum of z e, is linear in the coefficients.
        solved = np.zeros((len(linear), width))
        solved[:, kept] = linear * scale
        scores = blocks[..., -1] - (blocks[..., :width] @ solved[:, :, None])[..., 0]
        scores, gain = scores[..., kept], gain[:, -2:]
        scatter = np.einsum("bij,ilj->bil", scores * scale, gain)
        lost = k / (len(blocks) - k)
        variance = (1.0 + lost) * np.add.reduce(scatter**2)
        # An input that answers looks late, but not as if it stopped short.
        answers = (ratio * np.add.reduce(squares))[:, None] * (other != _SATURATION, True)
        variance += answers * np.einsum("ilj,ijk,ilk->il", gain, instruments, gain)
        # What the input does by itself this regression, without a prior, does not know where a loop
        # moves it as the flow goes, or about one large deflection, as another speed asks for.
        extra, whole = linear[:, -2:], linear[range(len(linear)), self._entries, None]
        whole[: len(ROWS), 0] = effect / scale[range(len(ROWS)), self._entries[: len(ROWS)]]
        away = np.divide(-extra, whole, out=np.zeros_like(extra), where=whole != 0.0)
        least = np.where(sure, ACQUITTED, DOUBTLESS)
        sure[:] = extra**2 > least**2 * variance
        return np.where(sure, away, 0.0), np.where(sure, extra * scale[:, -2:], 0.0)
