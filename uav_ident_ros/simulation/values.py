# SPDX-License-Identifier: Apache-2.0
"""Dataclasses from plain values, as they stand in a YAML file or come from options."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from uav_ident_ros.simulation.errors import SimulationError


def build(
    cls: Any,  # The dataclass
    values: Mapping[str, Any],  # Its fields by name; lists become tuples
    where: str,  # What they belong to, for messages
    # Fields that are dataclasses themselves, or sequences of them, with what one is called
    nested: Mapping[str, tuple[Any, str]] | None = None,
) -> Any:
    """Build a dataclass from a mapping.

    Raises
    ------
    SimulationError
        If a name is no field of it, or a field without a default is missing.
    """
    fields = {item.name: item for item in dataclasses.fields(cls)}
    for key in values:
        if key not in fields:
            raise SimulationError(f"{where} has no entry '{key}': there are {', '.join(fields)}")
    for name, item in fields.items():
        optional = {item.default, item.default_factory} != {dataclasses.MISSING}
        if name not in values and not optional:
            raise SimulationError(f"{where}: '{name}' is missing")
    out = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
    for key, (inner, called) in (nested or {}).items():
        if isinstance(found := out.get(key), tuple):
            out[key] = tuple(build(inner, value, called) for value in found)
        elif isinstance(found, Mapping):
            out[key] = build(inner, found, called)
    return cls(**out)
