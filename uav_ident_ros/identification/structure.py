# SPDX-License-Identifier: Apache-2.0
"""Model structures: which regressors exist and which coefficients are free.

The model is ``xdot = A f(x, u)`` (eq. (2) of Salman et al. 2006) with the state
``x = [p q r]`` in rad/s, body axes forward-right-down (FRD), and the inputs
``u = [de dr da dth]``, deviations from trim.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ROWS = ("pdot", "qdot", "rdot")
"""Row labels: angular accelerations, rad/s^2."""

INPUTS = ("de", "dr", "da", "dth")
"""Input labels, in the order of f(x, u): elevator, rudder, aileron, throttle."""

RATE_PRODUCTS = ("pq", "qr", "pr", "pp", "rr")
RATES = ("p", "q", "r")
_FIRST_FACTOR = np.array([RATES.index(product[0]) for product in RATE_PRODUCTS])
_SECOND_FACTOR = np.array([RATES.index(product[1]) for product in RATE_PRODUCTS])
SPECIFIC_FORCES = ("ay", "az")
CONSTANT = "1"

PAPER_REGRESSORS = RATE_PRODUCTS + RATES + INPUTS
AUGMENTED_REGRESSORS = (*PAPER_REGRESSORS, CONSTANT, *SPECIFIC_FORCES)

# Columns of f that every structure shares, in this order.
PRODUCT_COLUMNS = slice(0, 5)
RATE_COLUMNS = slice(5, 8)
INPUT_COLUMNS = slice(8, 12)
EXOGENOUS_COLUMNS = slice(8, None)
"""Inputs and, in the augmented structure, the constant and the specific forces."""

_BASELINE_ROWS = (
    ("pq", "qr", "p", "r", "dr", "da"),
    ("pr", "pp", "rr", "q", "de", "dth"),
    ("pq", "qr", "p", "r", "dr", "da"),
)
_THROTTLE_COUPLING = (("dth",), (), ("dth",))
_AUGMENTATION = ((CONSTANT, "ay"), (CONSTANT, "az"), (CONSTANT, "ay"))


@dataclass(frozen=True)
class Structure:
    """Regressors of a model and the sparsity of its coefficient matrix.

    Parameters
    ----------
    name : str
        ``baseline``, ``throttle_coupled`` or ``augmented``.
    regressors : tuple of str
        Labels of the n entries of f, in order.
    rows : tuple of tuple of str
        For each of pdot, qdot, rdot the regressors with a free coefficient.
    """

    name: str
    regressors: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def size(self) -> int:
        """Number n of regressors."""
        return len(self.regressors)

    @cached_property
    def mask(self) -> BoolArray:
        """Free coefficients, shape (3, n)."""
        mask = np.zeros((len(ROWS), self.size), dtype=bool)
        for i, row in enumerate(self.rows):
            for label in row:
                mask[i, self.regressors.index(label)] = True
        mask.flags.writeable = False
        return mask

    @cached_property
    def free(self) -> tuple[tuple[int, int], ...]:
        """(row, column) of every coefficient of the structure, row-major."""
        return tuple((int(i), int(j)) for i, j in np.argwhere(self.mask))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients, ``pdot/pq`` and so on, row-major."""
        return tuple(f"{ROWS[i]}/{self.regressors[j]}" for i, j in self.free)

    def index(self, name: str) -> tuple[int, int]:
        """Return (row, column) of the coefficient called `name`.

        Raises
        ------
        ValueError
            If the structure has no such coefficient.
        """
        try:
            return self.free[self.names.index(name)]
        except ValueError:
            raise ValueError(
                f"structure '{self.name}' has no coefficient '{name}'; "
                f"it has {', '.join(self.names)}"
            ) from None

    def regressor(
        self, x: FloatArray, u: FloatArray, force: FloatArray | None = None
    ) -> FloatArray:
        """Evaluate f(x, u).

        Parameters
        ----------
        x : (..., 3) array
            Rates p, q, r, rad/s, FRD.
        u : (..., 4) array
            Inputs de, dr, da, dth, deviations from trim.
        force : (..., 2) array, optional
            Specific forces ay, az, m/s^2, FRD; used by the augmented structure, zero if left out.

        Returns
        -------
        (..., n) array
            The regressors, in the order of `regressors`.
        """
        f = np.empty((*np.shape(x)[:-1], self.size))
        f[..., PRODUCT_COLUMNS] = x.take(_FIRST_FACTOR, axis=-1) * x.take(_SECOND_FACTOR, axis=-1)
        f[..., RATE_COLUMNS] = x
        f[..., INPUT_COLUMNS] = u
        if self.size > len(PAPER_REGRESSORS):
            f[..., 12] = 1.0
            f[..., 13:15] = 0.0 if force is None else force
        return f


def _with(*parts: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], ...]:
    return tuple(sum((part[i] for part in parts), ()) for i in range(len(ROWS)))


STRUCTURES = {
    s.name: s
    for s in (
        # Section 3 of Salman et al. 2006: 18 coefficients.
        Structure("baseline", PAPER_REGRESSORS, _with(_BASELINE_ROWS)),
        # Section 4, eq. (15): throttle couples into roll and yaw; 20 coefficients.
        Structure("throttle_coupled", PAPER_REGRESSORS, _with(_BASELINE_ROWS, _THROTTLE_COUPLING)),
        # Beyond the paper: constant (trim), and the specific forces that stand for
        # sideslip (ay) and angle of attack (az); 26 coefficients.
        Structure(
            "augmented",
            AUGMENTED_REGRESSORS,
            _with(_BASELINE_ROWS, _THROTTLE_COUPLING, _AUGMENTATION),
        ),
    )
}
"""The structures by name."""
