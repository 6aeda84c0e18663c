# SPDX-License-Identifier: Apache-2.0
"""What every reader of a log gives: streams of samples, channels with a meaning, findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.stamps import BoolArray, plausible

Effect = tuple[float, float, float, float]
"""Share of a channel in de, dr, da, dth; see `Channel`."""

Column = NDArray[Any]
"""Values of one field, in the type of the log."""

NO_EFFECT: Effect = (0.0, 0.0, 0.0, 0.0)

NS_PER_US = 1_000

LONGEST_LINE = 2000
"""Characters of the longest message: damaged or hostile files have names of any length."""

LONGEST_TITLE = 120

TRIMS = ("flight", "neutral", "learn")
"""Where the trim comes from: the median in flight, the channels' rest positions, or the identifier
itself, from the first steady stretch."""


class ImportLogError(Exception):
    """A log cannot be imported; the message names the file and what is there instead."""


@dataclass(frozen=True)
class Choice:
    """What to take from a log in place of the best."""

    # rates_topic, actuators_topic: PX4 topic or ArduPilot message type
    rates_topic: str | None = None
    actuators_topic: str | None = None
    rates_instance: int = 0  # Which gyro, of several
    actuators_instance: int = 0  # Which set of commands, of several


@dataclass(frozen=True)
class Channel:
    """One raw channel of the actuators and what it does."""

    name: str  # Name in the bag
    # Weights of the scaled channel in de (positive pitches down), dr (yaws left), da (rolls right),
    # dth: a column of the mixing matrix
    effect: Effect
    meaning: str  # What moves, in words, and where that is written
    # Factor from the raw deviation to full deflections (surfaces) or full throttle
    scale: float = 1.0
    neutral: float = 0.0  # Raw value at rest: a centred surface, a stopped motor
    unit: str = "normalised"  # Unit of the raw value
    trim: float | None = None  # Raw value in trimmed flight, where it is known


@dataclass(frozen=True, eq=False)
class Rates:
    """Samples of the gyro and the accelerometer, in one set of axes."""

    source: str  # Where in the log they are from
    t_ns: TimeArray  # (n,) Stamps, ns, in the order of the log
    rates: FloatArray  # (n, 3) Angular velocity, rad/s
    force: FloatArray | None  # (n, 3) Specific force, m/s^2; None if there is no accelerometer
    convention: str = "frd"  # ``frd`` or ``flu``


@dataclass(frozen=True, eq=False)
class Actuators:
    """Samples of every channel that was logged."""

    source: str  # Where in the log they are from
    t_ns: TimeArray  # (m,) Stamps, ns: from when on the values apply
    values: FloatArray  # (m, C) Raw values
    channels: tuple[Channel, ...]  # The C channels; those without effect are recorded, but not used


@dataclass(frozen=True, eq=False)
class Airspeed:
    """Samples of the airspeed."""

    source: str  # Where in the log they are from
    t_ns: TimeArray  # (m,) Stamps, ns
    values: FloatArray  # (m,) True airspeed, m/s


@dataclass(frozen=True, eq=False)
class Attitude:
    """Samples of the autopilot's own estimate of the attitude."""

    source: str  # Where in the log they are from
    t_ns: TimeArray  # (m,) Stamps, ns
    # (m, 4) Unit quaternions x, y, z, w that turn vectors from body axes (FRD) to north-east-down
    quaternion: FloatArray


@dataclass(frozen=True, eq=False)
class Setpoint:
    """Samples of the rates that the autopilot asked for."""

    source: str  # Where in the log they are from
    t_ns: TimeArray  # (m,) Stamps, ns
    rates: FloatArray  # (m, 3) p, q, r, rad/s, FRD


@dataclass(frozen=True, eq=False)
class Mode:
    """Modes that the autopilot was in, at each change."""

    source: str  # Where in the log they are from
    t_ns: TimeArray  # (m,) From when on, ns
    names: NDArray[np.str_]  # (m,) Names, as the autopilot has them


@dataclass
class Findings:
    """What there is to say about an import, a sentence each."""

    read: list[str] = field(default_factory=list)  # What the log itself says
    # What it does not say and was taken for granted
    assumed: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)  # What is missing or doubtful
    damage: list[str] = field(default_factory=list)  # How much of the file could not be read


@dataclass(frozen=True, eq=False)
class FlightLog:
    """A log in the project's own terms."""

    path: Path
    title: str  # What wrote it: ``PX4``, ``ArduPilot`` and so on, with versions
    rates: Rates
    actuators: Actuators
    findings: Findings  # What there is to say about it
    airspeed: Airspeed | None = None
    # Accelerometer from the centre of gravity, m, FRD
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Start and end of every stretch in the air, or armed, ns; None if the log does not say
    flown: list[tuple[int, int]] | None = None
    # Start and end of every stretch in which it was armed, ns; None if the log does not say
    armed: list[tuple[int, int]] | None = None
    attitude: Attitude | None = None
    setpoint: Setpoint | None = None
    mode: Mode | None = None
    hovers: bool = False  # Whether it is a multirotor, or a VTOL by the commands of its hover
    ground_speed: float = 0.0  # Median speed over ground in flight, m/s; 0 if it is not known
    # What the log says of the autopilot's parameters that matter, by name
    parameters: Mapping[str, float] = field(default_factory=dict)

    def streams(self) -> dict[str, Any]:
        """Return the streams that there are, by name."""
        names = ("rates", "actuators", "airspeed", "attitude", "setpoint", "mode")
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def in_flight(self, t_ns: TimeArray) -> BoolArray:
        """Whether each stamp lies in a stretch of flight; everywhere if there is none known."""
        if not self.flown:
            return np.ones(len(t_ns), dtype=bool)
        inside = [(start <= t_ns) & (t_ns <= end) for start, end in self.flown]
        return np.asarray(np.logical_or.reduce(inside))

    def with_plausible_stamps(self) -> FlightLog:
        """Return the log without samples whose stamp no clock gave.

        Raises
        ------
        ImportLogError
            If no rates or no actuators are left.
        """
        changed: dict[str, Any] = {}
        for name, stream in self.streams().items():
            good = plausible(stream.t_ns)
            if good.all():
                continue
            self.findings.damage.append(
                f"{name}: {int((~good).sum())} of {len(good)} samples have a stamp that no clock "
                "gave, and were left out"
            )
            changed[name] = _chosen(stream, good)
        return self._with(changed, "left with a usable stamp")

    def only_flight(self) -> FlightLog:
        """Return the log without what is known to be on the ground.

        Raises
        ------
        ImportLogError
            If the log does not say when it flew, or never did.
        """
        if not self.flown:
            reason = "it never flew" if self.flown is not None else "it does not say when it flew"
            raise ImportLogError(f"log '{self.path}': {reason}: leave --flight-only out")
        log = self._with(
            {
                name: _chosen(stream, self.in_flight(stream.t_ns))
                for name, stream in self.streams().items()
            },
            "in flight: leave --flight-only out",
        )
        self.findings.lost.append("what was logged on the ground is left out (--flight-only)")
        return log

    def _with(self, changed: dict[str, Any], where: str) -> FlightLog:
        log = replace(self, **changed)
        for name in ("rates", "actuators"):
            if not len(getattr(log, name).t_ns):
                raise ImportLogError(f"log '{self.path}' has no {name} {where}")
        return log


def _chosen(stream: Any, keep: BoolArray) -> Any:
    """Return a stream with some of its samples only."""
    arrays = {
        f.name: value[keep]
        for f in fields(stream)
        if isinstance(value := getattr(stream, f.name), np.ndarray)
    }
    return replace(stream, **arrays)


def unique_names(names: list[str]) -> list[str]:
    """Return the names with ``_2``, ``_3`` ... behind those that occur again."""
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return result


def printable(text: str, longest: int = LONGEST_LINE) -> str:
    """Return what a file says of itself as one line that can be printed, and not too long a one."""
    line = "".join(character if character.isprintable() else "?" for character in text)
    return line if len(line) <= longest else f"{line[:longest]}..."
