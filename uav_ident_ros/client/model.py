# SPDX-License-Identifier: Apache-2.0
"""The identified attitude dynamics ``xdot = A f(x, u)`` for a controller: NumPy only.

States ``x = [p q r]`` in rad/s, body axes forward-right-down, and with flow angles beta, alpha in
rad; inputs ``u = [de dr da dth]`` as in the identifier: ``u = M (scale (raw - trim))``, which act
after a transport delay.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.linearisation import Condition, linearise
from uav_ident_ros.identification.model import (
    flight_derivative,
    integrate,
    rates_derivative,
    with_own,
)
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    INPUT_COLUMNS,
    INPUTS,
    LAST_COLUMNS,
    OWN_COLUMNS,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)

LONGEST_STEP = 0.01
"""Longest step of a prediction, s: a tenth of the fastest mode of a small aircraft."""

MIN_SINGULAR_RATIO = 0.01
"""Least over largest singular value below which the control matrix counts as singular."""

INVERSION_INPUTS = ("de", "dr", "da")
"""Inputs of the inversion by default: a fixed-wing aircraft does not use throttle for attitude."""


class Refusal(Exception):  # noqa: N818  (it is an answer, not a mistake)
    """There is no usable model; the text gives the reason."""


@dataclass(frozen=True, eq=False)
class Inversion:
    """Inputs that produce a wanted angular acceleration."""

    u: FloatArray  # (4,) de, dr, da, dth; deviations from trim, 0 for those not used
    acceleration: FloatArray  # (3,) pdot, qdot, rdot of the model with these inputs, rad/s^2
    # Inputs at a limit: then `acceleration` may fall short of the wanted one
    limited: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class AttitudeModel:
    """Identified attitude dynamics.

    See Also
    --------
    uav_ident_ros.client.CoefficientSource : Provides it while the coefficients may be used.

    Examples
    --------
    >>> from uav_ident_ros.identification.structure import STRUCTURES
    >>> structure = STRUCTURES["baseline"]
    >>> values = np.zeros(structure.mask.shape)
    >>> known = {"pdot/p": -6.0, "pdot/da": 40.0, "qdot/de": -25.0, "rdot/dr": -8.0}
    >>> for name, value in known.items():
    ...     values[structure.index(name)] = value
    >>> model = AttitudeModel(structure, values, structure.mask)
    >>> rates = np.array([0.5, 0.0, 0.0])  # rad/s
    >>> model.acceleration(rates, np.zeros(4))
    array([-3.,  0.,  0.])
    >>> answer = model.invert(np.array([1.0, 0.5, 0.0]), rates)
    >>> answer.u.round(3).tolist()  # de, dr, da, dth
    [-0.02, 0.0, 0.1, 0.0]
    >>> model.predict(rates, answer.u, 0.1).round(2).tolist()
    [0.58, 0.05, 0.0]
    """

    structure: Structure  # Structure of the model, with the names of rows and columns
    values: FloatArray  # (R, n) A, SI units; 0 where a coefficient is left out
    known: BoolArray  # (R, n) Mask of the known coefficients
    # Flow angles, attitude and airspeed of the coefficients' tick, for a structure with flow angles
    flow: FlowState | None = None
    t_ns: int = 0  # Message time of the coefficients, ns; 0 for the author's own
    source: str = "identified"  # Source of the coefficients: or ``last good``, or ``nominal``
    # Coefficients unknown in the newest set, and taken from the fallback
    replaced: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()  # Coefficients unknown in the fallback, too: taken as 0

    def acceleration(
        self, x: FloatArray, u: FloatArray, force: FloatArray | None = None
    ) -> FloatArray:
        """Return pdot, qdot, rdot, shape (..., 3), rad/s^2.

        Parameters
        ----------
        x : (..., 3) or (..., 5) array
            Rates p, q, r, rad/s; with flow angles as states also beta, alpha, rad, by default those
            of the message.
        u : (..., 4) array
            Inputs de, dr, da, dth.
        force : (..., 2) array, optional
            Specific forces ay, az, m/s^2. The augmented structure uses them; without them their
            coefficients and the constant, which belongs to them, are left out.
        """
        f = self._regressors(self._state(x), np.asarray(u, dtype=np.float64), force)
        return np.asarray(f @ self.values[: len(ROWS)].T)

    def _regressors(self, x: FloatArray, u: FloatArray, force: FloatArray | None) -> FloatArray:
        """Return the regressors of a complete state, shape (..., n)."""
        if self.structure.has_flow:
            return self.structure.regressor(x[..., :3], u, x[..., 3:])
        f = self.structure.regressor(x, u, force)
        if force is None:
            f[..., CONSTANT_COLUMN : LAST_COLUMNS.stop] = 0.0
        return f

    def _state(self, x: FloatArray) -> FloatArray:
        """Return the state, completed by the flow angles of the message."""
        x = np.asarray(x, dtype=np.float64)
        if not self.structure.has_flow or x.shape[-1] > len(ROWS):
            return x
        flow = self._flow_state()
        angles = np.broadcast_to((flow.beta, flow.alpha), (*x.shape[:-1], 2))
        return np.concatenate((x, angles), axis=-1)

    def _flow_state(self) -> FlowState:
        if self.flow is None:
            raise Refusal(
                f"structure '{self.structure.name}' needs 'flow': where the aircraft is flying"
            )
        return self.flow

    def predict(
        self, x: FloatArray, u: FloatArray, dt: float, force: FloatArray | None = None
    ) -> FloatArray:
        """Return the state after `dt` s with the inputs held, shape as x.

        With flow angles as states, the attitude is integrated from that of the message; otherwise
        the forces are held. Parameters are those of `acceleration`.
        """
        given = np.asarray(x, dtype=np.float64)
        state = self._state(given)
        u = np.broadcast_to(np.asarray(u, dtype=np.float64), (*state.shape[:-1], 4))
        steps = max(1, math.ceil(dt / LONGEST_STEP))
        parts = list(np.moveaxis(state, -1, 0))
        f = self._regressors(0.0 * state, u, force)[..., : OWN_COLUMNS.start]
        drive = list(np.moveaxis(f @ self.values[:, : OWN_COLUMNS.start].T, -1, 0))
        derivative = rates_derivative(self.values)
        if self.structure.has_flow:
            flow = self._flow_state()
            parts += [np.full(state.shape[:-1], part) for part in flow.down]
            drive += [1.0 / flow.airspeed, 0.0, 0.0, 0.0]
            derivative = flight_derivative(self.values)
        if self.structure.own:
            drive += list(np.moveaxis(u, -1, 0))
            derivative = with_own(derivative, self.values, self.structure)
        step = (drive, drive, drive, dt / steps)
        *_, parts = integrate(derivative, parts, [step] * steps)
        return np.stack(parts[: given.shape[-1]], axis=-1)

    def linearize(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return A and B of ``xdot = A dx + B du`` about a state and inputs.

        With flow angles the states are p, q, r, beta, alpha, phi: remove the last row and column
        at constant bank. Without them they are p, q, r.

        Parameters
        ----------
        x : (3,) or (5,) array
            As in `acceleration`.
        u : (4,) array
            Inputs; only regressors of the author's own depend on them.
        """
        p, q, r, *angles = (float(value) for value in self._state(x))
        rates, inputs = (p, q, r), tuple(map(float, u))
        condition = Condition(math.inf, rates, inputs=inputs)
        if self.structure.has_flow:
            flow = self._flow_state()
            at = flow.airspeed, rates, flow.roll, flow.pitch
            condition = Condition(*at, *angles, inputs=inputs)
        return linearise(self.structure, self.values, condition)

    def invert(
        self,
        wanted: FloatArray,
        x: FloatArray,
        limits: FloatArray | None = None,
        force: FloatArray | None = None,
        inputs: Sequence[str] = INVERSION_INPUTS,
        input_forces: FloatArray | None = None,
    ) -> Inversion:
        """Return the smallest inputs that give the wanted angular acceleration.

        Inputs beyond their limits are set to them, and the other inputs compensate as far as
        possible.

        Parameters
        ----------
        wanted : (3,) array
            pdot, qdot, rdot, rad/s^2.
        x : (3,) or (5,) array
            State, as in `acceleration`.
        limits : (2, 4) array, optional
            Lower and upper limits of de, dr, da, dth, deviations from trim. They also weight the
            inputs: the sum of squares of their shares of the travel is minimised.
        force : (2,) array, optional
            As in `acceleration`.
        inputs : sequence of str
            Inputs that may be used.
        input_forces : (2, 4) array, optional
            Derivatives of ay, az by the inputs, m/s^2 per unit. The augmented structure's control
            derivatives are partial: they hold at given ay, az. With this they become whole.

        Raises
        ------
        Refusal
            If the known control derivatives cannot move an axis.
        """
        B = self.values[: len(ROWS), INPUT_COLUMNS]
        allowed = [INPUTS.index(name) for name in inputs]
        columns = [i for i in allowed if B[:, i].any()]  # unknown ones are 0
        bound = np.stack([np.full(4, -np.inf), np.full(4, np.inf)])
        if limits is not None:
            bound = np.asarray(limits, dtype=np.float64)
        travel = np.where(np.isfinite(bound).all(axis=0), bound[1] - bound[0], 1.0)
        if input_forces is not None and self.structure.has_forces:
            B = B + self.values[:, LAST_COLUMNS] @ input_forces
        unknown = [INPUTS[i] for i in allowed if i not in columns]
        _check_invertible((B * travel)[:, columns], unknown)
        drift = self.acceleration(x, np.zeros(4), force)
        u = _least_norm(B, np.asarray(wanted) - drift, columns, bound, travel)
        at_limit = [i for i in columns if u[i] in (bound[0, i], bound[1, i])]
        return Inversion(u, drift + B @ u, tuple(INPUTS[i] for i in at_limit))


def _check_invertible(B: FloatArray, unknown: Sequence[str]) -> None:
    """Raise `Refusal` if the control matrix of the known inputs is singular."""
    hint = f" ({', '.join(unknown)} not identified)" if unknown else ""
    if B.shape[1] < len(ROWS):
        raise Refusal(f"{B.shape[1]} known inputs cannot move three axes{hint}")
    directions, sizes, _ = np.linalg.svd(B)
    if sizes[-1] < MIN_SINGULAR_RATIO * sizes[0]:
        axis = ROWS[int(np.argmax(np.abs(directions[:, -1])))]
        raise Refusal(f"the control matrix is singular: nothing moves {axis} by itself{hint}")


def _least_norm(
    B: FloatArray, wanted: FloatArray, columns: Sequence[int], bound: FloatArray, travel: FloatArray
) -> FloatArray:
    """Return the least-norm inputs by the redistributed pseudo-inverse, shape (4,)."""
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
