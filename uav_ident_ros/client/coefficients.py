# SPDX-License-Identifier: Apache-2.0
"""One message of ``~/coefficients_named`` as plain values, with the mask of known coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    LAST_COLUMNS,
    PRODUCT_COLUMNS,
    RATE_COLUMNS,
    ROWS,
    STRUCTURES,
    BoolArray,
    FloatArray,
    Structure,
)
from uav_ident_ros.messages.published import (
    FIT_NAMES,
    ROW_USABLE_NAMES,
    STATE_FIELDS,
    STATE_NAMES,
    USABLE_NAME,
    entry_names,
)
from uav_ident_ros.messages.types import NS_PER_S, header_ns

MIN_T_RATIO = 3.0
"""t-ratio from which a coefficient is known."""

MAX_SHARE = 0.1
"""Largest sigma of a small but known coefficient, over the largest known one of its kind in its
row: such a cross coupling is significantly small."""


KINDS = (PRODUCT_COLUMNS, RATE_COLUMNS, INPUT_COLUMNS, LAST_COLUMNS)
"""Columns of one kind: rate products, rates, inputs, forces or flow angles."""


class MessageError(ValueError):
    """A message does not hold coefficients; the text names the problem."""


class NamedMessage(Protocol):
    """The fields used of a sensor_msgs/msg/JointState, independent of its decoder."""

    header: Any
    name: Sequence[str]
    position: Sequence[float]
    effort: Sequence[float]


@dataclass(frozen=True, eq=False)
class Coefficients:
    """Coefficients of ``xdot = A f(x, u)`` with their uncertainty and the verdict."""

    structure: Structure  # Structure of the model, with the names of rows and columns
    values: FloatArray  # (R, n) A, SI units, body axes forward-right-down
    sigma: FloatArray  # (R, n) Standard deviations; 0 for fixed or absent coefficients
    usable: bool = True  # The identifier's verdict on all moment rows
    usable_rows: tuple[bool, ...] = (True, True, True)  # Its verdict on each of pdot, qdot, rdot
    # Flow angles, attitude and airspeed; None for a structure without flow angles
    flow: FlowState | None = None
    fit: FloatArray | None = None  # (3,) Fit of the 1-second predictions of p, q, r, percent
    t_ns: int = 0  # Message time of the tick, ns

    @classmethod
    def from_message(cls, message: NamedMessage) -> Coefficients:
        """Read a message of ``~/coefficients_named``.

        Raises
        ------
        MessageError
            If entries are missing, not finite, of no known structure, or the airspeed is negative.
        """
        count = len(message.name)
        if not len(message.position) == len(message.effort) == count:
            raise MessageError(
                f"{count} names, {len(message.position)} positions and {len(message.effort)} "
                "efforts: coefficients_named has as many of each"
            )
        value = dict(zip(message.name, map(float, message.position), strict=True))
        sigma = dict(zip(message.name, map(float, message.effort), strict=True))
        others = {*STATE_NAMES, *FIT_NAMES, USABLE_NAME, *ROW_USABLE_NAMES}
        structure = _structure_of(value.keys() - others)
        if missing := [name for name in entry_names(structure) if name not in value]:
            raise MessageError(f"there is no entry '{missing[0]}': is this coefficients_named?")
        values, sigmas = (_matrix(structure, entries) for entries in (value, sigma))
        if not (np.isfinite(values).all() and (sigmas >= 0.0).all()):
            raise MessageError("a coefficient is not finite, or its sigma is negative or NaN")
        return cls(
            structure=structure,
            values=values,
            sigma=sigmas,
            usable=value[USABLE_NAME] == 1.0,
            usable_rows=tuple(value[name] == 1.0 for name in ROW_USABLE_NAMES),
            flow=_flow(value, sigma) if structure.has_flow else None,
            fit=np.array([value[name] for name in FIT_NAMES]),
            t_ns=header_ns(message),
        )

    @classmethod
    def from_file(cls, path: Path | str) -> Coefficients:
        """Read a coefficients file, as `replay` and the identifier's `~/save` write it.

        Raises
        ------
        CoefficientsFileError
            If it cannot be used.
        """
        from uav_ident_ros.files.coefficients_file import load_coefficients

        loaded = load_coefficients(path)
        return cls(STRUCTURES[loaded.structure], loaded.values, loaded.sigma, t_ns=loaded.t_ns)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients, ``pdot/pq`` and so on, row-major."""
        return self.structure.names

    def age(self, now_ns: int) -> float:
        """Age at message time `now_ns`, s."""
        return (now_ns - self.t_ns) / NS_PER_S

    @cached_property
    def known(self) -> BoolArray:
        """Mask of the known coefficients, shape (R, n); absent ones count as known zeros.

        A coefficient is known if its t-ratio reaches `MIN_T_RATIO`, or if its sigma is below
        `MAX_SHARE` of the largest known coefficient of its kind (rate products, rates, inputs,
        forces) in its row.
        """
        size = np.abs(self.values)
        clear = (size > 0.0) & (size >= MIN_T_RATIO * self.sigma)
        known = clear | (self.sigma == 0.0)
        found = np.where(clear, size, 0.0)
        for columns in KINDS:
            largest = found[:, columns].max(axis=1, keepdims=True, initial=0.0)
            known[:, columns] |= self.sigma[:, columns] <= MAX_SHARE * largest
        return np.asarray(known | ~self.structure.mask)


def _structure_of(names: set[str]) -> Structure:
    for structure in STRUCTURES.values():
        if set(structure.names) == names:
            return structure
    raise MessageError(
        f"{len(names)} coefficients of no known structure: there are {', '.join(STRUCTURES)}, "
        f"with entries like '{ROWS[0]}/p'"
    )


def _flow(value: dict[str, float], sigma: dict[str, float]) -> FlowState:
    states = {field: value[f"state/{field}"] for field in STATE_FIELDS}
    if not (np.isfinite(list(states.values())).all() and states["airspeed"] >= 0.0):
        raise MessageError("a state is not finite, or the airspeed is below zero")
    return FlowState(**states, beta_sigma=sigma["state/beta"], alpha_sigma=sigma["state/alpha"])


def _matrix(structure: Structure, entries: dict[str, float]) -> FloatArray:
    out = np.zeros(structure.mask.shape)
    out[structure.mask] = [entries[name] for name in structure.names]
    return out
