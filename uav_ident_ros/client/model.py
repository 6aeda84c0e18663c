# SPDX-License-Identifier: Apache-2.0
"""The identified attitude dynamics ``xdot = A f(x, u)`` for a controller: NumPy only.

States ``x = [p q r]`` in rad/s, body axes forward-right-down; inputs ``u = [de dr da dth]`` as the
identifier has them: ``u = M (scale (raw - trim))``, acting a transport delay later.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    RATE_COLUMNS,
    ROWS,
    SPECIFIC_FORCES,
    BoolArray,
    FloatArray,
    Structure,
)

STEP = 0.01
"""Longest step of a prediction, s: a tenth of the fastest mode of a small aircraft."""

MIN_SINGULAR_RATIO = 0.01
"""Least over largest singular value of the control matrix below which it is not inverted."""

SURFACES = ("de", "dr", "da")
"""What is inverted unless asked otherwise: throttle turns no fixed wing on purpose."""


class Refusal(Exception):  # noqa: N818  (it is an answer, not a mistake)
    """There is nothing to act on; the text gives the reason."""


@dataclass(frozen=True, eq=False)
class Inversion:
    """Inputs that produce a wanted angular acceleration.

    Parameters
    ----------
    u : (4,) array
        de, dr, da, dth; deviations from trim, 0 for those not used.
    acceleration : (3,) array
        pdot, qdot, rdot that the model gives with them, rad/s^2.
    limited : tuple of str
        Inputs at a limit: then `acceleration` may fall short of what was wanted.
    """

    u: FloatArray
    acceleration: FloatArray
    limited: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class AttitudeModel:
    """Identified attitude dynamics.

    Parameters
    ----------
    structure : Structure
        Names the rows and columns.
    values : (3, n) array
        A, SI units; 0 where a coefficient is left out.
    known : (3, n) bool array
        What may be acted on.
    t_ns : int
        Message time of the coefficients, ns; 0 for the author's own.
    source : str
        Where they are from: ``identified``, ``last good`` or ``nominal``.
    replaced : tuple of str
        Coefficients that are not the newest: unknown now, and taken from the fallback.
    left_out : tuple of str
        Coefficients that nobody knows: taken as 0.
    """

    structure: Structure
    values: FloatArray
    known: BoolArray
    t_ns: int = 0
    source: str = "identified"
    replaced: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def acceleration(
        self, x: FloatArray, u: FloatArray, force: FloatArray | None = None
    ) -> FloatArray:
        """Return pdot, qdot, rdot, shape (3,), rad/s^2.

        Parameters
        ----------
        x : (3,) array
            Rates p, q, r, rad/s.
        u : (4,) array
            Inputs de, dr, da, dth.
        force : (2,) array, optional
            Specific forces ay, az, m/s^2. The augmented structure uses them; without them their
            coefficients and the constant, which belongs to them, are left out.
        """
        f = self.structure.regressor(np.asarray(x), np.asarray(u), force)
        if force is None:
            f[..., INPUT_COLUMNS.stop :] = 0.0
        return np.asarray(self.values @ f)

    def predict(
        self, x: FloatArray, u: FloatArray, dt: float, force: FloatArray | None = None
    ) -> FloatArray:
        """Return the rates `dt` seconds on, shape (3,), with inputs and forces held.

        Parameters are those of `acceleration`.
        """
        x = np.array(x, dtype=np.float64)
        steps = max(1, math.ceil(dt / STEP))
        h = dt / steps
        for _ in range(steps):  # Runge-Kutta of order 4
            k1 = self.acceleration(x, u, force)
            k2 = self.acceleration(x + 0.5 * h * k1, u, force)
            k3 = self.acceleration(x + 0.5 * h * k2, u, force)
            k4 = self.acceleration(x + h * k3, u, force)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return x

    def linearize(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return A (3, 3) and B (3, 4) of ``xdot = A dx + B du`` about rates `x` and inputs `u`.

        The inputs enter linearly, so that `u` does not matter; it is there for the reader.
        """
        p, q, r = (float(value) for value in x)
        products = np.array(  # d(pq, qr, pr, pp, rr) / d(p, q, r)
            [[q, p, 0.0], [0.0, r, q], [r, 0.0, p], [2.0 * p, 0.0, 0.0], [0.0, 0.0, 2.0 * r]]
        )
        a = self.values[:, RATE_COLUMNS] + self.values[:, : RATE_COLUMNS.start] @ products
        return a, self.values[:, INPUT_COLUMNS].copy()

    def invert(
        self,
        wanted: FloatArray,
        x: FloatArray,
        limits: FloatArray | None = None,
        force: FloatArray | None = None,
        inputs: Sequence[str] = SURFACES,
        input_forces: FloatArray | None = None,
    ) -> Inversion:
        """Return the least inputs that give the wanted angular acceleration.

        Where limits are in the way, the inputs beyond them are set to them and the others
        make up for it as far as they can.

        Parameters
        ----------
        wanted : (3,) array
            pdot, qdot, rdot, rad/s^2.
        x : (3,) array
            Rates p, q, r, rad/s.
        limits : (2, 4) array, optional
            Least and largest de, dr, da, dth, deviations from trim. They also weigh the inputs:
            least is the sum of squares of their shares of the travel.
        force : (2,) array, optional
            As in `acceleration`.
        inputs : sequence of str
            Those that may be used.
        input_forces : (2, 4) array, optional
            What each input itself adds to ay, az, m/s^2 per unit. The augmented structure's
            control derivatives hold at given ay, az; with this they become whole ones. A
            rudder at the end of a tail makes a good part of its moment's worth of ay.

        Raises
        ------
        Refusal
            If an axis cannot be moved with what is known of the control derivatives.
        """
        columns = [INPUTS.index(name) for name in inputs if self._input_known(INPUTS.index(name))]
        bound = np.stack([np.full(4, -np.inf), np.full(4, np.inf)]) if limits is None else limits
        travel = np.where(np.isfinite(bound).all(axis=0), bound[1] - bound[0], 1.0)
        B = self.values[:, INPUT_COLUMNS]
        if input_forces is not None and self.structure.size > INPUT_COLUMNS.stop:
            B = B + self.values[:, -len(SPECIFIC_FORCES) :] @ input_forces
        self._check_invertible(B * travel, columns, inputs)
        drift = self.acceleration(x, np.zeros(4), force)
        u = _least_norm(B, np.asarray(wanted) - drift, columns, bound, travel)
        at_limit = [i for i in columns if u[i] in (bound[0, i], bound[1, i])]
        return Inversion(u, drift + B @ u, tuple(INPUTS[i] for i in at_limit))

    def _input_known(self, column: int) -> bool:
        """Whether anything is known to be moved by an input; what is not known counts as 0."""
        return bool(self.values[:, INPUT_COLUMNS.start + column].any())

    def _check_invertible(
        self, B: FloatArray, columns: Sequence[int], inputs: Sequence[str]
    ) -> None:
        """Refuse a control matrix that leaves an axis without an input."""
        unknown = [name for name in inputs if not self._input_known(INPUTS.index(name))]
        hint = f" ({', '.join(unknown)} not identified)" if unknown else ""
        if len(columns) < len(ROWS):
            raise Refusal(f"{len(columns)} known inputs cannot move three axes{hint}")
        directions, sizes, _ = np.linalg.svd(B[:, columns])
        if sizes[-1] < MIN_SINGULAR_RATIO * sizes[0]:
            axis = ROWS[int(np.argmax(np.abs(directions[:, -1])))]
            raise Refusal(f"the control matrix is singular: nothing moves {axis} by itself{hint}")


def _least_norm(
    B: FloatArray, wanted: FloatArray, columns: Sequence[int], bound: FloatArray, travel: FloatArray
) -> FloatArray:
    """Least-norm inputs by the redistributed pseudo-inverse, shape (4,)."""
    u = np.zeros(B.shape[1])
    free = list(columns)
    while free:
        left = wanted - B @ np.where(np.isin(np.arange(len(u)), free), 0.0, u)
        u[free] = travel[free] * (np.linalg.pinv(B[:, free] * travel[free]) @ left)
        beyond = [i for i in free if not bound[0, i] <= u[i] <= bound[1, i]]
        if not beyond:
            break
        u[beyond] = np.clip(u[beyond], bound[0, beyond], bound[1, beyond])
        free = [i for i in free if i not in beyond]
    return u
