# SPDX-License-Identifier: Apache-2.0
"""The paper's law Am_dot = e f^T K (eqs. (7), (8) of Salman et al. 2006)."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.estimators.estimator import Estimator
from uav_ident_ros.identification.estimators.information import MODEL_ERROR
from uav_ident_ros.identification.prior import Start
from uav_ident_ros.identification.regression import Regression, RowSamples
from uav_ident_ros.identification.scales import MEMORY, ROUNDING, START_TIME, SURE
from uav_ident_ros.identification.settings import LARGEST_NUMBER, Settings, SettingsError
from uav_ident_ros.identification.structure import PRODUCT_COLUMNS, BoolArray, FloatArray

DEFAULT_GAIN = SURE / START_TIME
"""Diagonal of K relative to the regressors' variances, 1/s: at the end of a cold start exp(-3), a
twentieth, of the initial error is left."""

EULER_LIMIT = 2.0
"""``dt f^T K f`` beyond which an explicit Euler step of the law overshoots and grows."""


def gain_matrix(gains: tuple[float, ...], n: int) -> FloatArray:
    """Return K from n diagonal or n*n row-major entries.

    Raises
    ------
    SettingsError
        If K is not symmetric positive semi-definite.
    """
    values = np.array(gains) if gains else np.full(n, DEFAULT_GAIN)
    k = np.diag(values) if len(values) == n else values.reshape(n, n)
    nothing = ROUNDING * (float(np.abs(k).max()) or 1.0)
    if np.abs(k - k.T).max() > nothing:
        i, j = np.unravel_index(np.argmax(np.abs(k - k.T)), k.shape)
        raise SettingsError(
            f"'gradient.gains' is not symmetric: K[{i},{j}] = {k[i, j]:g} but "
            f"K[{j},{i}] = {k[j, i]:g}; they must be equal",
        )
    lowest = float(np.linalg.eigvalsh(k).min())
    if lowest < -nothing:
        raise SettingsError(
            f"'gradient.gains' has the eigenvalue {lowest:g}: K must be positive semi-definite",
        )
    return np.asarray(k)


def gradient_step(
    coefficients: FloatArray,  # (3, n) A_m
    y: FloatArray,  # (3,) xdot, rad/s^2
    f: FloatArray,  # (n,) Regressors
    gain: FloatArray,  # (n, n) K, symmetric positive semi-definite
    free: BoolArray,  # (3, n) Coefficients that are estimated
    dt: float,  # s
    *,
    guarded: bool,  # Whether to take the exact step
) -> tuple[FloatArray, float]:
    """Return A_m after a step of the law, with e and f held, and the largest ``dt f^T K f``.

    In each row K acts through its principal submatrix of the free columns, which stays positive
    semi-definite. The guarded step is the exact solution, ``(1 - exp(-s dt)) / s`` with
    ``s = f^T K f``: no gain makes it overshoot. Otherwise it is Euler's ``dt``, unstable where
    ``dt f^T K f`` exceeds `EULER_LIMIT`.
    """
    e = y - coefficients @ f
    row_f = np.where(free, f, 0.0)
    direction = np.where(free, row_f @ gain, 0.0)
    s = (direction * row_f).sum(axis=1)
    length = np.full(3, dt)
    if guarded:
        moving = s > 0.0
        length[moving] = -np.expm1(-s[moving] * dt) / s[moving]
    return coefficients + (e * length)[:, None] * direction, float(s.max() * dt)


class GradientEstimator(Estimator):
    """The paper's law, sample by sample.

    The law gives no standard deviations. They are those of an instrumental variable on the same
    samples, widened by the distance from it.
    """

    def __init__(self, settings: Settings, start: Start) -> None:
        super().__init__(settings, start, (True,))
        law = settings.gradient
        self._gain = gain_matrix(law.gains, start.values.shape[1])
        self._normalisation = law.normalisation
        self._guarded = law.step == "guarded"
        self._power: FloatArray = np.zeros(start.values.shape[1])
        self._power_time = 0.0

    def update(
        self, samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray
    ) -> None:
        """Step the law with each of the samples.

        The law has no weights: a row of any weight above zero takes the whole step.
        """
        self.learning = weight > 0.0
        self.information.add([rows], weight)
        for y, f in zip(samples.y, samples.f, strict=True):
            self._step(y, f, samples.dt)
        reference = self.information.solve(self.coefficients)
        _, sigma = self.information.spread(reference)
        distance = self.coefficients - reference.values[0]
        distance = np.hypot(distance, MODEL_ERROR * self.coefficients)
        self.sigma = np.where(self.start.free, np.hypot(sigma[0], distance), 0.0)

    def _step(self, y: FloatArray, f: FloatArray, dt: float) -> None:
        """Step the law."""
        moved, step = gradient_step(
            self.coefficients,
            y,
            f,
            self._gain_now(f, dt),
            self.start.free,
            dt,
            guarded=self._guarded,
        )
        if not self._guarded and step > EULER_LIMIT:
            self.problem = (
                f"the Euler step of the gradient law is unstable: dt f^T K f = {step:.3g} "
                f"exceeds {EULER_LIMIT:g}; lower 'gradient.gains' or set 'gradient.step' to "
                "'guarded'"
            )
        if (np.abs(moved) < LARGEST_NUMBER).all():  # NaN fails too
            moved = self._limit(moved)
            moved = np.where(self.learning[:, None], moved, self.coefficients)
            self.coefficients = self.linear = moved
        else:
            self.problem = (
                "the gradient law has diverged and its coefficients are held at the last finite "
                "values: lower 'gradient.gains' or set 'gradient.step' to 'guarded'"
            )

    def _gain_now(self, f: FloatArray, dt: float) -> FloatArray:
        """Return K in SI units at a sample."""
        if self._normalisation == "none":
            return self._gain
        if self._normalisation == "power":
            return np.asarray(self._gain / (1.0 + f @ self._gain @ f))
        self._power_time = min(self._power_time + dt, MEMORY)
        share = dt / self._power_time
        self._power += share * (f**2 - self._power)
        scale = np.zeros_like(self._power)
        excited = self._power > 0.0
        scale[excited] = 1.0 / np.sqrt(self._power[excited])
        return np.asarray(self._gain * np.outer(scale, scale))

    def _limit(self, coefficients: FloatArray) -> FloatArray:
        """Limit the rate products to -1 ... 1; without normalisation nothing is limited."""
        if self._normalisation != "none":
            products = coefficients[:, PRODUCT_COLUMNS]
            np.clip(products, -1.0, 1.0, out=products)
        return coefficients
