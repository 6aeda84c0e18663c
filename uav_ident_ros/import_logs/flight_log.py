# SPDX-License-Identifier: Apache-2.0
"""What every reader of a log gives: streams of samples, channels with a meaning, findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import BoolArray, FloatArray
from uav_ident_ros.import_logs.stamps import Stretches, hold, inside

Effect = tuple[float, float, float, float]
"""Share of a channel in de, dr, da, dth; see `Channel`."""

NO_EFFECT: Effect = (0.0, 0.0, 0.0, 0.0)

LONGEST_LINE, LONGEST_TITLE = 2000, 120
"""Characters of the longest message and title: damaged files have names of any length."""

JOIN_NS = 200_000
"""Samples of two topics this close, ns, are of one cycle of the controller: the fastest run at
1 kHz or so, and what is published in one cycle is some microseconds apart."""

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
class Stream:
    """Samples of one kind."""

    source: str  # Where in the log they are from
    t_ns: TimeArray  # (n,) Stamps, ns, in the order of the log
    values: NDArray[Any]  # (n, ...) What was sampled; see `FlightLog.streams`

    def chosen(self, keep: BoolArray) -> Stream:
        """Return some of the samples only."""
        return Stream(self.source, self.t_ns[keep], self.values[keep])

    def joined(self, other: Stream) -> Stream:
        """Return both side by side, (n, C1 + C2); each value is held until its stream's next.

        Stamps of one controller cycle (closer than `JOIN_NS`) become one, the later. Before the
        first sample of a stream its values are NaN.
        """
        every = np.union1d(self.t_ns, other.t_ns)
        t_ns = every[np.append(np.diff(every) > JOIN_NS, True)]
        values = np.hstack([hold(t_ns, part.t_ns, part.values) for part in (self, other)])
        return Stream(f"{self.source} and {other.source}", t_ns, values)


def rates_stream(
    source: str,
    t_ns: TimeArray,
    rates: FloatArray,  # (n, 3) Angular velocity, rad/s
    force: FloatArray | None,  # (n, 3) Specific force, m/s^2; None if there is none
) -> Stream:
    """Put angular velocity and specific force side by side, NaN if there is no force."""
    force = np.full(rates.shape, np.nan) if force is None else force
    return Stream(source, t_ns, np.hstack([rates, force]))


@dataclass
class Findings:
    """What there is to say about an import, a sentence each."""

    damage: list[str] = field(default_factory=list)  # How much of the file could not be read
    read: list[str] = field(default_factory=list)  # What the log itself says
    # What it does not say and was taken for granted
    assumed: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)  # What is missing or doubtful


@dataclass(frozen=True, eq=False)
class FlightLog:
    """A log in the project's own terms."""

    path: Path
    title: str  # What wrote it: ``PX4``, ``ArduPilot`` and so on, with versions
    # By name; there are at least the first two:
    # rates      (n, 6) Angular velocity, rad/s, and specific force, m/s^2, NaN where there is none
    # actuators  (n, C) Raw values of every channel that was logged, from its stamp on
    # airspeed   (n,) True airspeed, m/s
    # attitude   (n, 4) Unit quaternions x, y, z, w from body axes (FRD) to north-east-down
    # setpoint   (n, 3) Rates that the autopilot asked for, rad/s, FRD
    # mode       (n,) Names of the modes that the autopilot was in, at each change
    streams: Mapping[str, Stream]
    channels: tuple[Channel, ...]  # Of the actuators; without effect they are recorded, not used
    findings: Findings  # What there is to say about it
    convention: str = "frd"  # Axes of the rates: ``frd`` or ``flu``
    # Accelerometer from the centre of gravity, m, FRD
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Stretches in the air, or armed; None if the log does not say
    flown: Stretches | None = None
    hovers: bool = False  # Whether it is a multirotor, or a VTOL by the commands of its hover
    ground_speed: float = 0.0  # Median speed over ground in flight, m/s; 0 if it is not known
    # What the log says of the autopilot's parameters that matter, by name
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def used(self) -> list[tuple[int, Channel]]:
        """Column and channel of everything that moves the aircraft."""
        return [(i, c) for i, c in enumerate(self.channels) if any(c.effect)]

    @cached_property
    def has_force(self) -> bool:
        """Whether there is an accelerometer."""
        return bool(np.isfinite(self.streams["rates"].values[:, 3:]).any())

    def in_flight(self, name: str) -> BoolArray:
        """Whether each sample lies in a stretch of flight; all if there is none known."""
        t_ns = self.streams[name].t_ns
        return inside(t_ns, self.flown) if self.flown else np.ones(len(t_ns), dtype=bool)

    def only_flight(self) -> FlightLog:
        """Return the log without what is known to be on the ground."""
        if not self.flown:
            reason = "it never flew" if self.flown is not None else "it does not say when it flew"
            raise ImportLogError(f"log '{self.path}': {reason}: leave --flight-only out")
        self.findings.lost.append("what was logged on the ground is left out (--flight-only)")
        streams = {name: s.chosen(self.in_flight(name)) for name, s in self.streams.items()}
        for name in ("rates", "actuators"):
            if not len(streams[name].t_ns):
                raise ImportLogError(
                    f"log '{self.path}' has no {name} in flight: leave --flight-only out"
                )
        return replace(self, streams=streams)


def printable(text: str, longest: int = LONGEST_LINE) -> str:
    """Return what a file says of itself as one line that can be printed, and not too long a one."""
    line = "".join(character if character.isprintable() else "?" for character in text)
    return line if len(line) <= longest else f"{line[:longest]}..."
