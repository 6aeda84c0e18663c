# SPDX-License-Identifier: Apache-2.0
"""Offline output-error fit of a model structure, the reference for a single online pass.

The method is multiple shooting. The record is cut into windows of one second, each with its own
initial state. Coefficients and initial states minimise the weighted squared residuals of the
rates (Jategaonkar, Flight Vehicle System Identification, 2015, ch. 4). Kaufman's variable
projection eliminates the initial states in each step: `scipy.optimize.least_squares` then solves a
dense problem in the coefficients alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from cases import Case
from scipy.optimize import least_squares

from uav_ident_ros.identification.model import bounded, integrate, rates_derivative
from uav_ident_ros.identification.prior import PRODUCT_SIGMA, start_from
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    PRODUCT_COLUMNS,
    BoolArray,
    FloatArray,
)

WINDOW = 1.0
"""Length of a shooting window, s."""

TRAINING_PART = 0.6
"""Fitted share of the flight."""

REWEIGHTINGS, EVALUATIONS = 2, 40
"""Number of fits, each with new weights of the axes from their residuals; and largest number of
evaluations in each."""

STATE_STEP = 1e-4
"""Step of the difference quotient in an initial rate, rad/s."""

COEFFICIENT_STEP = 1e-5
"""Step in a coefficient, relative to the larger of the coefficient and the least size below."""


@dataclass(frozen=True)
class Windows:
    """Measured signals over W windows of m cells."""

    h: float  # Width of a cell, s
    x: FloatArray  # (m + 1, 3, W) Rates at the edges, rad/s
    u: FloatArray  # (m, 4, W) Means of the inputs over the cells, delayed and lagged
    force: FloatArray  # (m + 1, 2, W) ay, az at the edges, m/s^2


def cut_windows(blocks: Sequence[Block], first_ns: float, last_ns: float) -> Windows:
    """Cut the signals between two times into consecutive windows."""
    m = max(1, round(WINDOW / blocks[0].h))
    x, u, force = [], [], []
    for block in blocks:
        for start in range(0, len(block.u) - m + 1, m):
            if block.t_ns[start] < first_ns or block.t_ns[start + m] > last_ns:
                continue
            x.append(block.x[start : start + m + 1])
            u.append(block.u[start : start + m])
            force.append(block.force[start : start + m + 1])
    joined = (np.ascontiguousarray(np.array(part).transpose(1, 2, 0)) for part in (x, u, force))
    return Windows(blocks[0].h, *joined)


def simulate(
    a: FloatArray,  # (3, n, P, 1 or W) Coefficients of P models
    x0: FloatArray,  # (3, P, W) Initial rates
    windows: Windows,  # Measured inputs and specific forces
) -> FloatArray:
    """Return the models' rates at the edges of the cells, shape (m + 1, 3, P, W).

    Integration is Runge-Kutta of order 4, with constant inputs in each cell.
    """
    drives = ((*_drive(a, windows, k), windows.h) for k in range(len(windows.u)))
    out = [x0.copy()]
    with np.errstate(over="ignore", invalid="ignore"):
        out += [np.stack(x) for x in integrate(rates_derivative(a), list(x0), drives)]
    return bounded(np.array(out))


def _drive(a: FloatArray, windows: Windows, k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A f without the rates, at the start, middle and end of cell k: (3, P, W) each."""
    columns = a[:, INPUT_COLUMNS.start :]
    base = sum(columns[:, j] * windows.u[k, j] for j in range(4))
    if columns.shape[1] == 4:
        return base, base, base
    base = base + columns[:, 4]
    left, right = windows.force[k], windows.force[k + 1]
    first, middle, last = (
        base + columns[:, 5] * f[0] + columns[:, 6] * f[1]
        for f in (left, 0.5 * (left + right), right)
    )
    return first, middle, last


class Problem:
    """Weighted residuals of the windows as a function of the free coefficients."""

    def __init__(
        self,
        free: BoolArray,  # (3, n) Coefficients to fit; the others stay zero
        windows: Windows,  # The record
    ) -> None:
        self.free, self.windows = free, windows
        self.x0 = windows.x[0].copy()
        self.weight = 1.0 / np.maximum(windows.x.std(axis=(0, 2)), 1e-3)
        columns = np.argwhere(free)[:, 1]
        self._products = np.flatnonzero(columns < PRODUCT_COLUMNS.stop)
        self._at: FloatArray | None = None

    def matrices(self, theta: FloatArray) -> FloatArray:
        """Return the coefficient matrices (3, n, P, 1) of P coefficient vectors (k, P)."""
        a = np.zeros((*self.free.shape, theta.shape[1], 1))
        a[self.free] = theta[:, :, None]
        return a

    def residual(self, theta: FloatArray) -> FloatArray:
        """Return the residuals with the best initial states, then those of the prior."""
        return self._evaluate(theta)[0]

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivative of the residuals."""
        return self._evaluate(theta)[1]

    def _evaluate(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self._at is None or not np.array_equal(self._at, theta):
            x0 = self._improved_start(theta)
            self._value = self._linearised(theta, x0)
            self._at = theta.copy()
            self.x0 = x0
        return self._value

    def _improved_start(self, theta: FloatArray) -> FloatArray:
        """Return the initial states after one Gauss-Newton step, (3, W)."""
        start = self._perturbed(self.x0)
        path = simulate(self.matrices(theta[:, None]), start, self.windows)
        residual, slopes = self._weighted(path)
        q, r = np.linalg.qr(slopes)
        step = np.linalg.solve(r, q.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0]
        return np.asarray(self.x0 - step.T)

    def _perturbed(self, x0: FloatArray) -> FloatArray:
        """Return the initial states, then those with one rate perturbed, (3, 4, W)."""
        start = np.repeat(x0[:, None], 4, axis=1)
        for i in range(3):
            start[i, 1 + i] += STATE_STEP
        return start

    def _weighted(self, path: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (W, 3 (m + 1)) and derivatives by initial state (W, 3 (m + 1), 3)."""
        weight = self.weight[:, None]
        base = path[:, :, 0]
        residual = _by_window((base - self.windows.x) * weight)
        slopes = [_by_window((path[:, :, 1 + i] - base) * (weight / STATE_STEP)) for i in range(3)]
        return residual, np.stack(slopes, axis=2)

    def _linearised(self, theta: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        count = len(theta)
        step = COEFFICIENT_STEP * np.maximum(np.abs(theta), 1.0)
        same = np.repeat(theta[:, None], 4, axis=1)
        moved = np.column_stack([same, theta[:, None] + np.diag(step)])
        start = np.concatenate([self._perturbed(x0), np.repeat(x0[:, None], count, axis=1)], axis=1)
        path = simulate(self.matrices(moved), start, self.windows)
        residual, slopes = self._weighted(path)
        weight = self.weight[:, None]
        jacobian = np.stack(
            [
                _by_window((path[:, :, 4 + k] - path[:, :, 0]) * (weight / step[k]))
                for k in range(count)
            ],
            axis=2,
        )
        q = np.linalg.qr(slopes)[0]
        both = np.concatenate([residual[:, :, None], jacobian], axis=2)
        both -= q @ (q.transpose(0, 2, 1) @ both)
        flat = both.reshape(-1, count + 1)
        # The online prior: the inertia ratios of a rigid body lie within -1 ... 1.
        prior = np.zeros((len(self._products), count))
        prior[np.arange(len(self._products)), self._products] = 1.0 / PRODUCT_SIGMA
        return (
            np.concatenate([flat[:, 0], theta[self._products] / PRODUCT_SIGMA]),
            np.concatenate([flat[:, 1:], prior]),
        )

    def reweight(self, theta: FloatArray) -> None:
        """Weight each axis by the inverse of its residual's standard deviation."""
        path = simulate(self.matrices(theta[:, None]), self.x0[:, None], self.windows)
        spread = np.sqrt(((path[:, :, 0] - self.windows.x) ** 2).mean(axis=(0, 2)))
        self.weight = 1.0 / np.maximum(spread, 1e-6)
        self._at = None


def _by_window(values: FloatArray) -> FloatArray:
    """Return values (m + 1, 3, W) as (W, 3 (m + 1))."""
    return np.ascontiguousarray(values.transpose(2, 0, 1)).reshape(values.shape[2], -1)


def fit(
    case: Case,  # The flight
    settings: Settings,  # Structure, fixed coefficients, delay and lag
    starts: Sequence[FloatArray],  # (3, n) Initial coefficients of the fits; the best fit counts
) -> FloatArray:
    """Return the coefficients of the settings' structure, (3, n), fitted to `TRAINING_PART`."""
    free = start_from(settings).free
    first, last = float(case.samples.imu_t_ns[0]), float(case.samples.imu_t_ns[-1])
    windows = cut_windows(case.blocks(settings), first, first + TRAINING_PART * (last - first))
    outcomes = []
    for start in starts:
        problem = Problem(free, windows)
        theta = np.clip(np.nan_to_num(start[free]), -1e3, 1e3)
        for _ in range(REWEIGHTINGS):
            found = least_squares(
                problem.residual,
                theta,
                problem.jacobian,
                x_scale="jac",
                max_nfev=EVALUATIONS,
                xtol=1e-6,
                ftol=1e-6,
            )
            theta = found.x
            problem.reweight(theta)
        # With unknown noise variance the likelihood depends on the product of the residuals' rms.
        outcomes.append((float(-np.log(problem.weight).sum()), theta))
    coefficients = np.zeros(free.shape)
    coefficients[free] = min(outcomes, key=lambda outcome: outcome[0])[1]
    return coefficients
