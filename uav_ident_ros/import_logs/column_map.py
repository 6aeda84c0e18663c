# SPDX-License-Identifier: Apache-2.0
"""What the columns of a table mean: a YAML file, checked entry by entry."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import yaml

from uav_ident_ros.files.strict_yaml import yaml_problem
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.import_logs.flight_log import Channel, ImportLogError

TIME_UNITS = {"s": Decimal(10**9), "ms": Decimal(10**6), "us": Decimal(10**3), "ns": Decimal(1)}
"""Nanoseconds in each unit of time."""

RATE_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180.0}
FORCE_UNITS = {"m/s^2": 1.0, "g": 9.80665}
SPEED_UNITS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0}
AXES = ("frd", "flu")

AXES_OF_A_VECTOR = 3

EXAMPLE = """\
time: {column: t, unit: s}
axes: frd
rates: {columns: [p, q, r], unit: rad/s}
specific_force: {columns: [ax, ay, az], unit: m/s^2}
airspeed: {column: tas, unit: m/s}
channels:
  elevator: {column: servo_2, trim: 1500.0, scale: 0.002, de: 1.0}
  throttle: {column: servo_3, neutral: 1000.0, scale: 0.001, dth: 1.0}
"""
"""A column map, for the help and the documentation."""


@dataclass(frozen=True)
class ColumnMap:
    """Meaning of the columns of a table."""

    time: str  # Column of the time
    time_ns: Decimal  # Its unit, ns
    rates: tuple[str, ...]  # Columns of the rates
    rates_factor: float  # Their unit, rad/s
    axes: str  # ``frd`` or ``flu``
    channels: dict[str, Channel]  # Channel by column
    force: tuple[str, ...] = ()  # Columns of the specific force; empty for none
    force_factor: float = 1.0  # Their unit, m/s^2
    airspeed: str = ""  # Column of the true airspeed; empty for none
    airspeed_factor: float = 1.0  # Its unit, m/s
    # Accelerometer from the centre of gravity, m, FRD
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delimiter: str = ","  # Between the cells

    @property
    def columns(self) -> list[str]:
        """Every column that is read."""
        airspeed = [self.airspeed] if self.airspeed else []
        return [self.time, *self.rates, *self.force, *airspeed, *self.channels]


def load_column_map(path: Path) -> ColumnMap:
    """Read a column map.

    Raises
    ------
    ImportLogError
        If it cannot be read, an entry is missing, unknown or not allowed.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        return _column_map(content)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise ImportLogError(f"column map '{path}' cannot be read: {reason}") from None
    except yaml.YAMLError as error:
        raise ImportLogError(f"column map '{path}' is no YAML: {yaml_problem(error)}") from None
    except _WrongError as error:
        raise ImportLogError(f"column map '{path}': {error}") from None


class _WrongError(Exception):
    """What is wrong with an entry, and what would be right."""


def _column_map(content: Any) -> ColumnMap:
    vector, single = ("columns", "unit", "counts"), ("column", "unit")
    top = _mapping(content, "", ("time", "axes", "rates", "channels"),
                   ("specific_force", "airspeed", "lever_arm", "delimiter"))  # fmt: skip
    time = _mapping(top["time"], "time", ("column",), single)
    rates = _mapping(top["rates"], "rates", ("columns",), vector)
    force = _mapping(top.get("specific_force", {}), "specific_force", (), vector)
    airspeed = _mapping(top.get("airspeed", {}), "airspeed", (), single)
    delimiter = top.get("delimiter", ",")
    if not isinstance(delimiter, str) or len(delimiter) != 1:
        raise _WrongError(f"'delimiter' is {delimiter!r}: one character is needed")
    arm = _three(top.get("lever_arm", [0.0, 0.0, 0.0]), "lever_arm", "numbers forward, right, down")
    x, y, z = (_number(value, "lever_arm") for value in arm)
    return ColumnMap(
        time=str(time["column"]),
        time_ns=_choice(time.get("unit", "s"), "time.unit", TIME_UNITS),
        rates=_columns(rates, "rates"),
        rates_factor=_choice(rates.get("unit"), "rates.unit", RATE_UNITS) / _counts(rates, "rates"),
        axes=_choice(top["axes"], "axes", {axes: axes for axes in AXES}),
        channels=_channels(_mapping(top["channels"], "channels")),
        force=_columns(force, "specific_force") if force else (),
        force_factor=_choice(force.get("unit", "m/s^2"), "specific_force.unit", FORCE_UNITS)
        / _counts(force, "specific_force"),
        airspeed=str(_mapping(airspeed, "airspeed", ("column",), single)["column"])
        if airspeed
        else "",
        airspeed_factor=_choice(airspeed.get("unit", "m/s"), "airspeed.unit", SPEED_UNITS),
        lever_arm=(x, y, z),
        delimiter=delimiter,
    )


def _channels(entries: Mapping[str, Any]) -> dict[str, Channel]:
    known = ("column", "trim", "neutral", "scale", "unit", *INPUTS)
    channels: dict[str, Channel] = {}
    for name, value in entries.items():
        where = f"channels.{name}"
        entry = _mapping(value, where, (), known)
        column = str(entry.get("column", name))
        if column in channels:
            raise _WrongError(f"'{where}': column '{column}' is used twice")

        def number(key: str, default: float, entry: Any = entry, where: str = where) -> float:
            return _number(entry.get(key, default), f"{where}.{key}")

        de, dr, da, dth = (number(u, 0.0) for u in INPUTS)
        channels[column] = Channel(
            str(name),
            (de, dr, da, dth),
            f"column '{column}'",
            number("scale", 1.0),
            number("neutral", 0.0),
            str(entry.get("unit", "as in the table")),
            None if entry.get("trim") is None else number("trim", 0.0),
        )
    if not any(any(channel.effect) for channel in channels.values()):
        raise _WrongError(f"no channel says what it moves: give weights of {', '.join(INPUTS)}")
    return channels


def _mapping(
    value: Any, name: str, needed: Sequence[str] = (), known: Sequence[str] | None = None
) -> Mapping[str, Any]:
    """Check that a mapping has what is needed, and nothing unknown; any names if none are known."""
    prefix = f"{name}." if name else ""
    if not isinstance(value, Mapping):
        owner = f"'{name}'" if name else "the file"
        raise _WrongError(f"{owner} must hold entries 'name: value' (see import_log --help)")
    allowed = (*needed, *(known or ()))
    for key in value if allowed else ():
        if key not in allowed:
            near = difflib.get_close_matches(str(key), allowed, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(allowed)}"
            raise _WrongError(f"there is no entry '{prefix}{key}': {hint}")
    for key in needed:
        if key not in value:
            raise _WrongError(f"'{prefix}{key}' is missing (see import_log --help)")
    return value


def _choice(value: Any, name: str, allowed: Mapping[str, Any]) -> Any:
    if value not in [*allowed]:
        said = "missing" if value is None else f"'{value}'"
        raise _WrongError(f"'{name}' is {said}: allowed are {', '.join(allowed)}")
    return allowed[value]


def _three(value: Any, name: str, what: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != AXES_OF_A_VECTOR:
        raise _WrongError(f"'{name}' is {value!r}: three {what} are needed")
    return value


def _columns(entry: Mapping[str, Any], name: str) -> tuple[str, ...]:
    return tuple(map(str, _three(entry.get("columns"), f"{name}.columns", "columns x, y, z")))


def _counts(entry: Mapping[str, Any], name: str) -> float:
    """Return how many counts of a raw sensor make up one unit."""
    counts = _number(entry.get("counts", 1.0), f"{name}.counts")
    if not counts:
        raise _WrongError(f"'{name}.counts' is 0: how many counts make up one unit?")
    return counts


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _WrongError(f"'{name}' is {value!r}: a finite number is needed")
    return float(value)
