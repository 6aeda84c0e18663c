# SPDX-License-Identifier: Apache-2.0
"""Samples of the regression problem, row by row: what each row explains, with what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from uav_ident_ros.identification.regression import Layout, Regression
from uav_ident_ros.identification.structure import FloatArray


@dataclass(frozen=True)
class RowSamples:
    """Samples of the regression problem with what belongs to each row.

    Parameters
    ----------
    y, residual : (rows, m) array
        What is explained, and what the coefficients before left of it.
    f, z : (rows, m, c) array
        Regressors and instruments: all columns of the problem, or those that `pick` leaves.
    dt : float
        Time that each sample stands for, s.
    """

    y: FloatArray
    residual: FloatArray
    f: FloatArray
    z: FloatArray
    dt: float

    @classmethod
    def of(cls, samples: Regression, residual: FloatArray) -> Self:
        """Return samples with residuals (m, rows); their regressors are those of every row."""
        rows = residual.shape[1]
        f, z = (part[None].repeat(rows, axis=0) for part in (samples.f, samples.z))
        return cls(samples.y.T, residual.T, f, z, samples.dt)

    @classmethod
    def join(cls, parts: Sequence[RowSamples], newest: int) -> Self:
        """Return the newest of samples that follow one another."""
        y, residual, f, z = (
            np.concatenate([getattr(part, name) for part in parts], axis=1)
            for name in ("y", "residual", "f", "z")
        )
        first = max(y.shape[1] - newest, 0)
        return cls(y[:, first:], residual[:, first:], f[:, first:], z[:, first:], parts[-1].dt)

    @property
    def time(self) -> float:
        """Time that all samples together stand for, s."""
        return self.dt * self.y.shape[1]

    def pick(self, layout: Layout) -> RowSamples:
        """Return the samples with the columns that each row is regressed on; 0 where unused."""
        rows, used = np.arange(len(self.y))[:, None], layout.used[:, :, None]
        f, z = (
            np.where(used, part[rows, :, layout.index], 0.0).transpose(0, 2, 1)
            for part in (self.f, self.z)
        )
        return replace(self, f=f, z=z)

    def uninstrumented(self) -> RowSamples:
        """Return the samples with the regressors as their own instruments."""
        return replace(self, z=self.f)
