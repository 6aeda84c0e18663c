# SPDX-License-Identifier: Apache-2.0
"""What the columns of a table mean: a YAML file, checked entry by entry."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import yaml

from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.import_logs.flight_log import Channel, Effect, ImportLogError

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
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise ImportLogError(f"column map '{path}' cannot be read: {reason}") from None
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise ImportLogError(f"column map '{path}' is no YAML: {reason}") from None
    return _Reader(path, content).column_map()


class _Reader:
    """Checks the entries of one file.

    Parameters
    ----------
    path : Path
        The file, for messages.
    content : Any
        What YAML made of it.
    """

    def __init__(self, path: Path, content: Any) -> None:
        self._path = path
        self._content = self._mapping(content, "the file")

    def column_map(self) -> ColumnMap:
        """Return the whole map."""
        known = ("time", "axes", "rates", "specific_force", "airspeed", "channels", "lever_arm")
        self._refuse_unknown(self._content, (*known, "delimiter"), "")
        time = self._entry("time", ("column", "unit"))
        rates = self._entry("rates", ("columns", "unit", "counts"))
        force = self._entry("specific_force", ("columns", "unit", "counts"), optional=True)
        airspeed = self._entry("airspeed", ("column", "unit"), optional=True)
        return ColumnMap(
            time=self._text(time, "time", "column"),
            time_ns=TIME_UNITS[self._choice(time, "time.unit", "s", tuple(TIME_UNITS))],
            rates=self._vector(rates, "rates"),
            rates_factor=RATE_UNITS[self._choice(rates, "rates.unit", None, tuple(RATE_UNITS))]
            / self._counts(rates, "rates"),
            axes=self._choice(self._content, "axes", None, AXES),
            channels=self._channels(),
            force=self._vector(force, "specific_force") if force else (),
            force_factor=FORCE_UNITS[
                self._choice(force, "specific_force.unit", "m/s^2", tuple(FORCE_UNITS))
            ]
            / self._counts(force, "specific_force"),
            airspeed=self._text(airspeed, "airspeed", "column") if airspeed else "",
            airspeed_factor=SPEED_UNITS[
                self._choice(airspeed, "airspeed.unit", "m/s", tuple(SPEED_UNITS))
            ],
            lever_arm=self._lever_arm(),
            delimiter=self._delimiter(),
        )

    def _fail(self, reason: str) -> ImportLogError:
        return ImportLogError(f"column map '{self._path}': {reason}")

    def _mapping(self, value: Any, name: str) -> Mapping[str, Any]:
        if not isinstance(value, Mapping):
            raise self._fail(f"{name} must hold entries 'name: value' (see import_log --help)")
        return value

    def _refuse_unknown(
        self, entries: Mapping[str, Any], known: tuple[str, ...], prefix: str
    ) -> None:
        for name in entries:
            if name not in known:
                near = difflib.get_close_matches(str(name), known, n=1)
                hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}"
                raise self._fail(f"there is no entry '{prefix}{name}': {hint}")

    def _entry(
        self, name: str, known: tuple[str, ...], *, optional: bool = False
    ) -> Mapping[str, Any]:
        if name not in self._content:
            if optional:
                return {}
            raise self._fail(f"'{name}' is missing (see import_log --help)")
        entry = self._mapping(self._content[name], f"'{name}'")
        self._refuse_unknown(entry, known, f"{name}.")
        return entry

    def _text(self, entry: Mapping[str, Any], name: str, key: str) -> str:
        if key not in entry:
            raise self._fail(f"'{name}.{key}' is missing")
        return str(entry[key])

    def _choice(
        self, entry: Mapping[str, Any], name: str, default: str | None, allowed: tuple[str, ...]
    ) -> str:
        value = entry.get(name.rpartition(".")[2], default)
        if value not in allowed:
            said = "missing" if value is None else f"'{value}'"
            raise self._fail(f"'{name}' is {said}: allowed are {', '.join(allowed)}")
        return str(value)

    def _vector(self, entry: Mapping[str, Any], name: str) -> tuple[str, ...]:
        columns = entry.get("columns")
        if not isinstance(columns, list) or len(columns) != AXES_OF_A_VECTOR:
            raise self._fail(f"'{name}.columns' is {columns!r}: three columns x, y, z are needed")
        return tuple(str(column) for column in columns)

    def _counts(self, entry: Mapping[str, Any], name: str) -> float:
        """Return how many counts of a raw sensor make up one unit."""
        counts = self._number(entry.get("counts", 1.0), f"{name}.counts")
        if not counts:
            raise self._fail(f"'{name}.counts' is 0: how many counts make up one unit?")
        return counts

    def _number(self, value: Any, name: str) -> float:
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise self._fail(f"'{name}' is {value!r}: a finite number is needed")
        return float(value)

    def _lever_arm(self) -> tuple[float, float, float]:
        given = self._content.get("lever_arm", [0.0, 0.0, 0.0])
        if not isinstance(given, list) or len(given) != AXES_OF_A_VECTOR:
            raise self._fail(
                f"'lever_arm' is {given!r}: three numbers forward, right, down (m) are needed"
            )
        x, y, z = (self._number(value, "lever_arm") for value in given)
        return x, y, z

    def _delimiter(self) -> str:
        given = self._content.get("delimiter", ",")
        if not isinstance(given, str) or len(given) != 1:
            raise self._fail(f"'delimiter' is {given!r}: one character is needed")
        return given

    def _channels(self) -> dict[str, Channel]:
        entries = self._mapping(self._content.get("channels"), "'channels'")
        known = ("column", "trim", "neutral", "scale", "unit", *INPUTS)
        channels: dict[str, Channel] = {}
        for name, value in entries.items():
            entry = self._mapping(value, f"'channels.{name}'")
            self._refuse_unknown(entry, known, f"channels.{name}.")
            column = str(entry.get("column", name))
            if column in channels:
                raise self._fail(f"'channels.{name}': column '{column}' is used twice")
            de, dr, da, dth = (
                self._number(entry.get(u, 0.0), f"channels.{name}.{u}") for u in INPUTS
            )
            effect: Effect = (de, dr, da, dth)
            trim = entry.get("trim")
            channels[column] = Channel(
                str(name),
                effect,
                f"column '{column}'",
                self._number(entry.get("scale", 1.0), f"channels.{name}.scale"),
                self._number(entry.get("neutral", 0.0), f"channels.{name}.neutral"),
                str(entry.get("unit", "as in the table")),
                None if trim is None else self._number(trim, f"channels.{name}.trim"),
            )
        if not any(any(channel.effect) for channel in channels.values()):
            raise self._fail(f"no channel says what it moves: give weights of {', '.join(INPUTS)}")
        return channels
