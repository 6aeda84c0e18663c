# SPDX-License-Identifier: Apache-2.0
"""Model structures: which regressors exist and which coefficients are free.

The model is ``xdot = A f(x, u)`` (eq. (2) of Salman et al. 2006) with the state
``x = [p q r]`` in rad/s, body axes forward-right-down (FRD), and the inputs
``u = [de dr da dth]``, deviations from trim. `flight_dynamics` adds sideslip and angle of attack:
rows of A for the specific forces ay and az, and for corrections to the kinematics of both angles.

The order of rows and columns is defined here alone; other modules use the labels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ROWS = ("pdot", "qdot", "rdot")
"""Moment rows: angular accelerations, rad/s^2."""

FORCE_ROWS = ("ay", "az")
"""Force rows: specific forces along y and z, m/s^2."""

KINEMATIC_ROWS = ("betadot", "alphadot")
"""Corrections to the kinematics of sideslip and angle of attack, rad/s: sensor biases, and in
sideslip the term p alpha_0 by the angle of attack alpha_0 at zero az."""

INPUTS = ("de", "dr", "da", "dth")
"""Input labels, in the order of f(x, u): elevator, rudder, aileron, throttle."""

MAIN_INPUTS = {"pdot": "da", "qdot": "de", "rdot": "dr"}
"""Main input of each moment row."""

RATE_PRODUCTS = ("pq", "qr", "pr", "pp", "rr")
RATES = ("p", "q", "r")
SPECIFIC_FORCES = ("ay", "az")
FLOW_ANGLES = ("beta", "alpha")
"""Sideslip and angle of attack, rad; zero where ay and az are zero with the inputs at trim."""

CONSTANT = "1"

PAPER_REGRESSORS = RATE_PRODUCTS + RATES + INPUTS
AUGMENTED_REGRESSORS = (*PAPER_REGRESSORS, CONSTANT, *SPECIFIC_FORCES)
FLIGHT_REGRESSORS = (*PAPER_REGRESSORS, CONSTANT, *FLOW_ANGLES)

# Columns of f common to all structures, in this order.
PRODUCT_COLUMNS = slice(0, 5)
RATE_COLUMNS = slice(5, 8)
INPUT_COLUMNS = slice(8, 12)
MAIN_COLUMNS = np.array([PAPER_REGRESSORS.index(MAIN_INPUTS[row]) for row in ROWS])
"""Column of each moment row's main input."""

MAIN_PLACES = MAIN_COLUMNS - INPUT_COLUMNS.start
"""Place of each moment row's main input among the inputs."""

MAIN_DERIVATIVES = np.arange(len(ROWS)), MAIN_COLUMNS
"""Index of each moment row's main control derivative."""

STATE_COLUMNS = slice(0, INPUT_COLUMNS.start)
"""Regressors made of rates."""

# Columns of the structures that go beyond the paper.
CONSTANT_COLUMN = len(PAPER_REGRESSORS)
LAST_COLUMNS = slice(CONSTANT_COLUMN + 1, CONSTANT_COLUMN + 3)
"""Specific forces ay, az, or the flow angles beta, alpha."""

EXOGENOUS_COLUMNS = slice(INPUT_COLUMNS.start, LAST_COLUMNS.stop)
"""Inputs and, in the augmented structure, the constant and the specific forces."""

OWN_COLUMNS = slice(LAST_COLUMNS.stop, None)
"""Regressors of `Structure.own`, the author's."""

FLOW_FORCES = tuple(zip(FLOW_ANGLES, FORCE_ROWS, KINEMATIC_ROWS, strict=True))
"""Each flow angle, the force that it causes, and the row of its kinematics."""

_FIRST_FACTOR = np.array([RATES.index(product[0]) for product in RATE_PRODUCTS])
_SECOND_FACTOR = np.array([RATES.index(product[1]) for product in RATE_PRODUCTS])
_BASELINE_ROWS = (
    ("pq", "qr", "p", "r", "dr", "da"),
    ("pr", "pp", "rr", "q", "de", "dth"),
    ("pq", "qr", "p", "r", "dr", "da"),
)
_THROTTLE_COUPLING = (("dth",), (), ("dth",))
_AUGMENTATION = ((CONSTANT, "ay"), (CONSTANT, "az"), (CONSTANT, "ay"))
_FLOW = ((CONSTANT, "beta"), (CONSTANT, "alpha"), (CONSTANT, "beta"))
# The side force by the yaw rate is as large as that by sideslip; without it yaw damping is a third
# too small. The tail's lift by the pitch rate is a hundredth of the lift slope: az/q is left out,
# because its instrument would bias az/alpha (docs/decisions.md).
_FORCES = (("p", "r", "dr", "beta"), ("de", "alpha"), ("p", CONSTANT), (CONSTANT,))


class FlowRows(NamedTuple):
    """Rows and columns of a flow angle in a structure."""

    force: int  # Row of the force that the angle causes
    angle: int  # Column of the angle
    others: tuple[int, ...]  # Columns of the other regressors of that force: rates, a surface
    kinematics: int  # Row of the corrections to the angle's kinematics
    missing: tuple[int, ...]  # Columns of these corrections


class Regressor(NamedTuple):
    """A regressor of the author's own: a function of rates and inputs."""

    label: str  # In the names of its coefficients
    # From p, q, r, rad/s, and de, dr, da, dth, floats or arrays, to its value
    value: Callable[..., Any]
    sigma: float  # Prior standard deviation of its coefficients, rad/s^2 per unit
    power: float = 2.0  # Power of the airspeed with which its coefficients grow


@dataclass(frozen=True)
class Structure:
    """Regressors of a model and the sparsity of its coefficient matrix.

    Parameters
    ----------
    name : str
        ``baseline``, ``throttle_coupled``, ``augmented`` or ``flight_dynamics``.
    regressors : tuple of str
        Labels of the n entries of f, in order.
    rows : tuple of tuple of str
        For each of `row_labels` the regressors with a free coefficient.
    own : tuple of Regressor
        The last of the regressors, which are the author's own.
    """

    name: str
    regressors: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    own: tuple[Regressor, ...] = ()

    def extended(self, name: str, rows: Mapping[str, Sequence[Regressor]]) -> Structure:
        """Return this structure with more regressors in its moment rows.

        Parameters
        ----------
        name : str
            Name of the new structure; as a key of `STRUCTURES` it is a choice of ``structure``.
        rows : mapping
            For some of the rows pdot, qdot, rdot the additional regressors.

        Raises
        ------
        ValueError
            If this structure is of the paper, a row is none of the moments, or a label is taken.
        """
        own = tuple(dict.fromkeys(regressor for more in rows.values() for regressor in more))
        labels = tuple(regressor.label for regressor in own)
        if CONSTANT not in self.regressors or self.own:
            raise ValueError(
                f"structure '{self.name}' has no place for more regressors: take "
                "'augmented' or 'flight_dynamics'"
            )
        if unknown := set(rows) - set(ROWS):
            raise ValueError(f"'{min(unknown)}' is no moment row: {', '.join(ROWS)} are")
        if len({*self.regressors, *labels}) < len(self.regressors) + len(labels):
            raise ValueError(f"a label of {', '.join(labels)} is taken in '{self.name}'")
        with_more = tuple(
            (*row, *(regressor.label for regressor in rows.get(label, ())))
            for label, row in zip(self.row_labels, self.rows, strict=True)
        )
        return replace(
            self, name=name, regressors=self.regressors + labels, rows=with_more, own=own
        )

    @cached_property
    def size(self) -> int:
        """Number n of regressors."""
        return len(self.regressors)

    @cached_property
    def has_flow(self) -> bool:
        """Whether sideslip and angle of attack are states, with rows for their forces."""
        return FLOW_ANGLES[0] in self.regressors

    @cached_property
    def has_forces(self) -> bool:
        """Whether the specific forces ay and az are regressors."""
        return SPECIFIC_FORCES[0] in self.regressors

    @property
    def row_labels(self) -> tuple[str, ...]:
        """Labels of the R rows of A: three, or seven with sideslip and angle of attack."""
        return (*ROWS, *FORCE_ROWS, *KINEMATIC_ROWS)[: len(self.rows)]

    @property
    def dense_rows(self) -> tuple[str, ...]:
        """Labels of the rows in the dense message."""
        return self.row_labels[: len(ROWS) + len(FORCE_ROWS)]

    def column(self, label: str) -> int:
        """Return the column of the regressor called `label`."""
        return self.regressors.index(label)

    @cached_property
    def mask(self) -> BoolArray:
        """Mask of the free coefficients, shape (R, n)."""
        mask = np.array([[label in row for label in self.regressors] for row in self.rows])
        mask.flags.writeable = False
        return mask

    @cached_property
    def flow(self) -> tuple[FlowRows, ...]:
        """Rows and columns of both flow angles; none without them."""
        found = []
        for angle, force, kinematics in FLOW_FORCES if self.has_flow else ():
            row, column = self.row_labels.index(force), self.column(angle)
            missing = self.row_labels.index(kinematics)
            made_by, missed = (np.flatnonzero(self.mask[i]).tolist() for i in (row, missing))
            made_by.remove(column)
            found.append(FlowRows(row, column, tuple(made_by), missing, tuple(missed)))
        return tuple(found)

    @cached_property
    def constants(self) -> BoolArray:
        """Mask of the coefficients of the constant, shape (R, n)."""
        return np.asarray(self.mask & (np.array(self.regressors) == CONSTANT))

    @cached_property
    def free(self) -> tuple[tuple[int, int], ...]:
        """(row, column) of every coefficient of the structure, row-major."""
        return tuple((int(i), int(j)) for i, j in np.argwhere(self.mask))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients, ``pdot/pq`` and so on, row-major."""
        return tuple(f"{self.row_labels[i]}/{self.regressors[j]}" for i, j in self.free)

    @cached_property
    def places(self) -> dict[str, tuple[int, int]]:
        """(row, column) of every coefficient by its name, row-major."""
        return dict(zip(self.names, self.free, strict=True))

    def index(self, name: str) -> tuple[int, int]:
        """Return (row, column) of the coefficient called `name`.

        Raises
        ------
        ValueError
            If the structure has no such coefficient.
        """
        try:
            return self.places[name]
        except KeyError:
            raise ValueError(
                f"structure '{self.name}' has no coefficient '{name}'; "
                f"it has {', '.join(self.names)}"
            ) from None

    def regressor(self, x: FloatArray, u: FloatArray, last: FloatArray | None = None) -> FloatArray:
        """Evaluate f(x, u).

        Parameters
        ----------
        x : (..., 3) array
            Rates p, q, r, rad/s, FRD.
        u : (..., 4) array
            Inputs de, dr, da, dth, deviations from trim.
        last : (..., 2) array, optional
            Last two regressors: specific forces ay, az, m/s^2, FRD, or flow angles beta, alpha,
            rad, by the structure; zero if omitted.

        Returns
        -------
        (..., n) array
            The regressors, in the order of `regressors`.
        """
        f = np.empty((*np.shape(x)[:-1], self.size))
        f[..., PRODUCT_COLUMNS] = x.take(_FIRST_FACTOR, axis=-1) * x.take(_SECOND_FACTOR, axis=-1)
        f[..., RATE_COLUMNS] = x
        f[..., INPUT_COLUMNS] = u
        if self.size > CONSTANT_COLUMN:
            f[..., CONSTANT_COLUMN] = 1.0
            f[..., LAST_COLUMNS] = 0.0 if last is None else last
        if self.own:
            f[..., OWN_COLUMNS] = self.own_values(x, u)
        return f

    def own_values(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Evaluate the author's own regressors, shape (..., number); parameters of `regressor`."""
        signals = (*np.moveaxis(x, -1, 0), *np.moveaxis(u, -1, 0))
        values = [np.broadcast_to(own.value(*signals), x.shape[:-1]) for own in self.own]
        return np.stack(values, axis=-1)


def _with(*parts: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], ...]:
    return tuple(sum((part[i] for part in parts), ()) for i in range(len(ROWS)))


STRUCTURES: dict[str, Structure] = {
    s.name: s
    for s in (
        # Section 3 of Salman et al. 2006: 18 coefficients.
        Structure("baseline", PAPER_REGRESSORS, _with(_BASELINE_ROWS)),
        # Section 4, eq. (15): throttle couples into roll and yaw; 20 coefficients.
        Structure("throttle_coupled", PAPER_REGRESSORS, _with(_BASELINE_ROWS, _THROTTLE_COUPLING)),
        # Beyond the paper: constant (trim), and specific forces in place of sideslip (ay) and
        # angle of attack (az); 26 coefficients.
        Structure(
            "augmented",
            AUGMENTED_REGRESSORS,
            _with(_BASELINE_ROWS, _THROTTLE_COUPLING, _AUGMENTATION),
        ),
        # Sideslip and angle of attack as states: 26 coefficients of the moments, 6 of the
        # forces, 3 of the kinematics.
        Structure(
            "flight_dynamics",
            FLIGHT_REGRESSORS,
            (*_with(_BASELINE_ROWS, _THROTTLE_COUPLING, _FLOW), *_FORCES),
        ),
    )
}
"""The structures by name: the choices of the setting ``structure``."""
