# SPDX-License-Identifier: Apache-2.0
"""Delay and servo lag from the response to injected signals.

An injected signal is independent of gusts and of the autopilot's answers to them. With the right
delay and lag, the residual of the equation of motion does not correlate with it at any shift: the
test of over-identifying restrictions of instrumental variables (Sargan 1958, Hansen 1982). The test
statistic is chi-squared, so the delay and lag of its minimum have standard deviations.

All signals are kept as cross-spectra of windows that overlap by half. There a delay and a lag are
factors, and noise of any colour is a weight.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.prior import FORCE_SIGMA, INPUT_SIGMA, RATE_SIGMA
from uav_ident_ros.identification.regression import NEGLIGIBLE
from uav_ident_ros.identification.scales import BLOCKS, INDEPENDENT_TIME, ROUNDING, SAMPLE_TIME
from uav_ident_ros.identification.structure import BoolArray, FloatArray

ComplexArray = NDArray[np.complex128]

WINDOW_SIZE = round(HORIZONS[-1] / SAMPLE_TIME)
"""Samples of a window, 5 s: much longer than delays and lags."""

SHIFT = 2.0 * SAMPLE_TIME
"""Time between the shifts of the injected signals, s: means over samples contain nothing faster."""

SHIFTS = SHIFT * np.arange(round(HORIZONS[0] / SHIFT) + 1)
"""Shifts at which the signals are instruments, s: up to the horizon of a prediction."""

_HARMONICS = np.arange(1, round(HORIZONS[-1] / (2.0 * SHIFT)) + 1)
_OMEGA = 2.0 * np.pi * _HARMONICS / HORIZONS[-1]
# The squares of two overlapping tapers add up to one, as without windows.
_TAPER = np.sin(np.pi * (np.arange(WINDOW_SIZE) + 0.5) / WINDOW_SIZE)[:, None] / np.sqrt(
    WINDOW_SIZE
)
_SMOOTH = np.ones(round(HORIZONS[-1] / INDEPENDENT_TIME))  # Harmonics in a mean of the noise

# Signals: injected de dr da, then p q r, ay az, de dr da, and the slopes of p q r.
_INJECTED, _INPUTS, _SIZE = slice(0, 3), slice(8, 11), 14
_SIGMA = np.array([np.inf] * 3 + [RATE_SIGMA] * 3 + [FORCE_SIGMA] * 2 + [INPUT_SIGMA] * 3)
# Of each axis: regressors, inputs, instruments, slope. Roll and yaw go together.
_AXES = (
    ([3, 5, 6], [9, 10], [1, 2], 11),
    ([4, 7], [8], [0], 12),
    ([3, 5, 6], [9, 10], [1, 2], 13),
)


class Found(NamedTuple):
    """Delay and lag of the least statistic, with their covariance."""

    total: float  # Delay and lag together, s
    square: float  # Square of the lag, s^2: the response is smooth in it, also at no lag
    covariance: FloatArray  # (2, 2) Of these two
    rise: float  # Of the statistic at distant sums, in standard deviations

    @property
    def lag(self) -> tuple[float, float]:
        """Lag and its standard deviation, s."""
        off = float(np.sqrt(self.covariance[1, 1])) * np.array([-1.0, 0.0, 1.0])
        low, here, high = np.sqrt(np.maximum(self.square + off, 0.0)).tolist()
        return here, max(high - here, here - low)


class InjectedResponse:
    """Response of the aircraft to injected signals, as cross-spectra of all signals."""

    def __init__(self) -> None:
        self._spectra: ComplexArray = np.zeros((len(_OMEGA), _SIZE, _SIZE), dtype=complex)
        self.windows = 0.0  # Discounted number of windows in the sums
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; the spectra stay."""
        self._half: FloatArray = np.zeros((0, _SIZE))

    def add(
        self,
        x: FloatArray,  # (N + 1, 5) Rates, ay and az, at the edges of N steps
        u: FloatArray,  # (N, 4) Means of the inputs over the steps, not delayed
        injected: FloatArray,  # The same of the injected signals
        lag: float,  # First-order lag of the inputs, s
    ) -> None:
        """Add an even number of steps that continue the last."""
        steps = np.concatenate((injected[:, :3], 0.5 * (x[1:] + x[:-1]), u[:, :3]), axis=1)
        slopes = np.diff(x[::2, :3], axis=0) / SAMPLE_TIME
        new = np.concatenate((0.5 * (steps[::2] + steps[1::2]), slopes), axis=1)
        signals, keep = np.concatenate((self._half, new)), np.exp(-0.5 / BLOCKS)
        while len(signals) >= WINDOW_SIZE:
            window, signals = signals[:WINDOW_SIZE], signals[WINDOW_SIZE // 2 :]
            if not (window[:, _INJECTED].any() and np.isfinite(window).all()):
                continue
            lines = np.fft.rfft((window - window.mean(axis=0)) * _TAPER, axis=0)[_HARMONICS]
            lines[:, _INPUTS] *= 1.0 + 1j * lag * _OMEGA[:, None]
            self._spectra = keep * self._spectra + lines.conj()[:, :, None] * lines[:, None]
            self.windows = keep * self.windows + 1.0
        self._half = signals

    def find(
        self,
        delays: FloatArray,  # Of the grid, s
        lags: Sequence[float],  # The same, s; a single one is known
        far: float,  # Distance of sums at which the rise is taken, s
    ) -> Generator[None, None, Found | None]:
        """Return, in steps, the delay and lag of the least statistic; None without information."""
        rows = [_Row(self._spectra, self.windows, axis) for axis in range(len(_AXES))]
        points = np.array([(delay + lag, lag * lag) for lag in lags for delay in delays])
        yield
        for _ in range(2):  # The noise is that of the residual, which needs a model
            best = points[np.argmin(_statistic(rows, points))]
            for row in rows:
                row.weigh(best)
            yield
        values = _statistic(rows, points)
        point, least = points[values.argmin()], float(values.min())
        free = np.array([True, len(lags) > 1])
        for _ in points:
            yield
            ahead = _gauss_newton(_moments(rows, point)[0], point, free)
            then = _statistic(rows, ahead)
            if then[-1] >= least - ROUNDING:
                break
            first = int(np.argmax(then < least))
            point, least = ahead[first], float(then[first])
        return _estimated(rows, point, free, least, values[np.abs(points[:, 0] - point[0]) > far])


class _Row:
    """Equation of motion of one axis, projected on the instruments."""

    def __init__(self, spectra: ComplexArray, windows: float, axis: int) -> None:
        self._fixed, self._inputs, injected, self._slope = _AXES[axis]
        self._precision = np.diag(_SIGMA[self._fixed + self._inputs] ** -2.0)
        self._spectra, self._windows = spectra, windows
        instruments = np.zeros((len(_OMEGA), _SIZE, len(injected), len(SHIFTS)), dtype=complex)
        for k, column in enumerate(injected):
            instruments[:, column, k] = np.exp(-1j * _OMEGA[:, None] * SHIFTS)
        instruments = instruments.reshape(len(_OMEGA), _SIZE, -1)
        self._products = instruments.conj().swapaxes(1, 2) @ spectra
        self._powers = self._products @ instruments
        own = np.einsum("kjj->j", self._powers).real
        there = int((own > ROUNDING * own.max()).sum())
        self.freedom = there - len(self._precision)
        self._by_chance = there / (windows * len(_OMEGA))
        self._slopes = spectra[:, self._slope, self._slope].real
        self._weigh(self._slopes)

    def _weigh(self, left: FloatArray) -> None:
        """Set the weight from a residual's spectrum, smoothed over harmonics."""
        noise = left + ROUNDING * self._slopes + NEGLIGIBLE
        count = np.convolve(np.ones(len(noise)), _SMOOTH, "same")
        self._weight = self._windows * count / np.convolve(noise, _SMOOTH, "same")
        power = np.tensordot(self._weight, self._powers, 1).real
        power += max(ROUNDING * float(np.trace(power)), ROUNDING) * np.eye(len(power))
        root = np.linalg.inv(np.linalg.cholesky(power))
        self._seen = self._weight[:, None, None] * (root @ self._products)

    def weigh(self, point: FloatArray) -> None:
        """Set the weight from the residual at a sum and a square of the lag."""
        left = self._combined(point)[1][..., -1]
        self._weigh(_power(self._spectra, left[..., None])[:, 0, 0].real)

    def statistic(self, points: FloatArray) -> FloatArray:
        """Return the chi-squared of residual times instruments at points (C, 2)."""
        inputs = np.tensordot(_response(points)[0], self._seen[..., self._inputs], 1).real
        others = self._seen[..., [*self._fixed, self._slope]].sum(axis=0).real
        others = np.broadcast_to(others, (len(points), *others.shape))
        signals = np.concatenate((others[..., :-1], inputs, others[..., -1:]), axis=2)
        gram = signals.swapaxes(1, 2) @ signals
        solved = np.linalg.solve(gram[:, :-1, :-1] + self._precision, gram[:, :-1, -1:])
        return np.asarray(gram[:, -1, -1] - (gram[:, -1:, :-1] @ solved)[:, 0, 0])

    def moments(self, point: FloatArray) -> FloatArray:
        """Return products of the derivatives by sum and by square, and of the residual, (2, 3, 3).

        First projected on the instruments, then the expected part by chance of any instruments.
        """
        seen, maps = self._combined(point)
        whole = np.tensordot(self._weight, _power(self._spectra, maps), 1).real
        return np.stack((seen.T @ seen, self._by_chance * whole))

    def _combined(self, point: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """Return derivatives by sum and by square, and the residual, without the regressors' part.

        Projected on the instruments, (Z, 3), and as maps from the signals, (K, S, 3).
        """
        response, *slopes = (part[0] for part in _response(point[None]))
        count, inputs = len(self._precision), slice(len(self._fixed), len(self._precision))
        maps: ComplexArray = np.zeros((len(_OMEGA), _SIZE, count + 3), dtype=complex)
        maps[:, self._fixed, range(inputs.start)] = maps[:, self._slope, -1] = 1.0
        maps[:, self._inputs, range(inputs.start, count)] = response[:, None]
        effect = self._solved(maps)[1][inputs, -1]
        for k, slope in enumerate(slopes, count):
            maps[:, self._inputs, k] = slope[:, None] * effect
        seen, solved = self._solved(maps)
        out = np.vstack((-solved, np.eye(3)))
        return seen @ out, np.asarray(maps @ out)

    def _solved(self, maps: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return projections of maps on instruments, and the last three regressed on the others."""
        seen = (self._seen @ maps).sum(axis=0).real
        f, y = seen[:, :-3], seen[:, -3:]
        return seen, np.linalg.solve(f.T @ f + self._precision, f.T @ y)


def _power(spectra: ComplexArray, maps: ComplexArray) -> ComplexArray:
    """Return the cross-spectra of mapped signals, (K, m, m)."""
    return np.asarray(maps.conj().swapaxes(1, 2) @ spectra @ maps)


def _statistic(rows: Sequence[_Row], points: FloatArray) -> FloatArray:
    """Return the statistic of all rows at sums and squares (C, 2)."""
    return np.asarray(np.sum([row.statistic(points) for row in rows], axis=0))


def _moments(rows: Sequence[_Row], point: FloatArray) -> FloatArray:
    """Return the moments of all rows, (2, 3, 3)."""
    return np.asarray(np.sum([row.moments(point) for row in rows], axis=0))


def _response(points: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return the frequency response to an input at points (C, 2), and its derivatives by both."""
    lag = np.sqrt(points[:, 1:])
    follows = 1.0 / (1.0 + 1j * _OMEGA * lag)
    response = np.exp(-1j * _OMEGA * (points[:, :1] - lag)) * follows
    return response, -1j * _OMEGA * response, -0.5 * _OMEGA**2 * follows * response


def _gauss_newton(moments: FloatArray, point: FloatArray, free: BoolArray) -> FloatArray:
    """Return points along a Gauss-Newton step, the farthest first; no lag is below zero."""
    step, info = np.zeros(2), moments[:2, :2] + ROUNDING * np.eye(2)
    step[free] = np.linalg.solve(info[free][:, free], moments[:2, 2][free])
    if point[1] + step[1] < 0.0:
        step[1] = -point[1]
        step[0] = (moments[0, 2] - moments[0, 1] * step[1]) / info[0, 0]
    return np.asarray(point + step * 0.5 ** np.arange(len(_SMOOTH))[:, None])


def _estimated(
    rows: Sequence[_Row],
    point: FloatArray,  # Sum and square of the least statistic
    free: BoolArray,  # (2,) Whether they were free
    least: float,  # Its value
    far: FloatArray,  # The statistic at distant sums
) -> Found | None:
    """Return the estimate with its covariance; None without information.

    Instruments explain a share of all motion by chance. The bias by that share is removed, and its
    size counts as an error. Its information is removed, too.
    """
    seen, by_chance = _moments(rows, point)
    information = (seen - by_chance)[:2, :2][free][:, free]
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        return None
    freedom = sum(row.freedom for row in rows) - int(free.sum())
    covariance, back = np.zeros((2, 2)), np.zeros(2)
    covariance[np.ix_(free, free)] = np.linalg.inv(information) * max(least / freedom, 1.0)
    moves = free & (np.array([True, False]) | (point > 0.0))
    back[moves] = np.linalg.solve(seen[:2, :2][moves][:, moves], -by_chance[:2, 2][moves])
    total, square = point + back
    rise = float(np.sqrt(max(far.min(initial=np.inf) - least, 0.0)))
    return Found(float(total), max(float(square), 0.0), covariance + np.outer(back, back), rise)
