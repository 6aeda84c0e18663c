# SPDX-License-Identifier: Apache-2.0
"""True coefficients of a simulated flight, in a file beside its bag."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from uav_ident_ros.files.strict_yaml import UNUSABLE
from uav_ident_ros.identification.structure import Structure

TRUTH_FILE = "truth.yaml"
"""Name of the file in the bag's folder."""


@dataclass(frozen=True)
class Truth:
    """True coefficients over time, by name."""

    # Values at the start of the flight, SI
    values: Mapping[str, float] = field(default_factory=dict)
    # Times, s after the first rates, and factors on the coefficients from then on
    changes: tuple[tuple[float, Mapping[str, float]], ...] = ()

    def steps(self, name: str, end: float) -> tuple[list[float], list[float]]:
        """Return times, s, and values of a coefficient up to `end`; empty if unknown."""
        if name not in self.values:
            return [], []
        times, values = [0.0], [self.values[name]]
        for time, factors in self.changes:
            if name in factors and time < end:
                times += [time, time]
                values += [values[-1], values[-1] * factors[name]]
        return [*times, end], [*values, values[-1]]


def read_truth(
    bag: Path,  # The bag; the file lies in its folder
    # Structure of the estimates. An aircraft's local derivatives hold at fixed flow angles: they
    # are the truth of a structure with both angles, not of one with `ay` and `az` in their place
    structure: Structure,
) -> Truth:
    """Read the true coefficients of a flight; empty if there is no valid file."""
    path = (bag if bag.is_dir() else bag.parent) / TRUTH_FILE
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        values = dict(content.get("coefficients") or {})
        if not values and {"alpha", "beta"} <= set(structure.regressors):
            values = dict(content.get("local_derivatives") or {})
        changes = tuple(
            (float(change["time"]), {k: float(v) for k, v in change["factors"].items()})
            for change in content.get("changes") or ()
        )
        return Truth({name: float(value) for name, value in values.items()}, changes)
    except (*UNUSABLE, AttributeError, TypeError, ValueError, KeyError):
        return Truth()  # not a file from the simulation
