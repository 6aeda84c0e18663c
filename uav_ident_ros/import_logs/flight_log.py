# SPDX-License-Identifier: Apache-2.0
"""Result of every reader of logs: streams of samples, channels with their effects, findings."""

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
"""Most characters of a message and of a title: damaged files have names of any length."""

JOIN_NS = 200_000
"""Longest time between samples of two topics from one cycle of the controller, ns. Cycles take
about 1 ms or more; the messages of one cycle are some microseconds apart."""

TRIMS = ("flight", "neutral", "learn")
"""Sources of the trim: the median in flight, the channels' rest positions, or the identifier's
estimate from the first steady stretch."""


class ImportLogError(Exception):
    """A log cannot be imported; the message names the file and the reason."""


@dataclass(frozen=True)
class Choice:
    """The user's choice of messages in place of the best ones."""

    # rates_topic, actuators_topic: PX4 topic or ArduPilot message type
    rates_topic: str | None = None
    actuators_topic: str | None = None
    rates_instance: int = 0  # Which gyro, of several
    actuators_instance: int = 0  # Which set of commands, of several


@dataclass(frozen=True)
class Channel:
    """One raw channel of the actuators and its effect."""

    name: str  # Name in the bag
    # Weights of the scaled channel in de (positive pitches down), dr (yaws left), da (rolls right),
    # dth: a column of the mixing matrix
    effect: Effect
    meaning: str  # Moved part, in words, and the source of this information
    # Factor from the raw deviation to parts of full deflection (surfaces) or full throttle
    scale: float = 1.0
    neutral: float = 0.0  # Raw value at rest: a centred surface, a stopped motor
    unit: str = "normalised"  # Unit of the raw value
    trim: float | None = None  # Raw value in trimmed flight, where it is known


@dataclass(frozen=True, eq=False)
class Stream:
    """Samples of one kind."""

    source: str  # Messages or topic in the log
    t_ns: TimeArray  # (n,) Stamps, ns, in the order of the log
    values: NDArray[Any]  # (n, ...) Values; see `FlightLog.streams`

    def chosen(self, keep: BoolArray) -> Stream:
        """Return the stream of the samples with `keep` true."""
        return Stream(self.source, self.t_ns[keep], self.values[keep])

    def joined(self, other: Stream) -> Stream:
        """Return both side by side, (n, C1 + C2); each value holds until its stream's next.

        Stamps closer than `JOIN_NS`, of one controller cycle, merge into the later one. Before
        the first sample of a stream its values are NaN.
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
    """Return the stream of angular velocity and specific force, NaN if there is no force."""
    force = np.full(rates.shape, np.nan) if force is None else force
    return Stream(source, t_ns, np.hstack([rates, force]))


@dataclass
class Findings:
    """Facts, assumptions and defects of an import, a sentence each."""

    damage: list[str] = field(default_factory=list)  # Unreadable parts of the file
    read: list[str] = field(default_factory=list)  # Facts from the log
    # Assumptions where the log has no information
    assumed: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)  # Missing or doubtful data


@dataclass(frozen=True, eq=False)
class FlightLog:
    """A log in the units, axes and names of this package."""

    path: Path
    title: str  # Firmware and version, such as ``PX4 v1.15.0``
    # By name; rates and actuators are always present:
    # rates      (n, 6) Angular velocity, rad/s, and specific force, m/s^2, NaN where there is none
    # actuators  (n, C) Raw values of every logged channel, valid from the stamp on
    # airspeed   (n,) True airspeed, m/s
    # attitude   (n, 4) Unit quaternions x, y, z, w from body axes (FRD) to north-east-down
    # setpoint   (n, 3) Rates requested by the autopilot, rad/s, FRD
    # mode       (n,) Name of the autopilot's mode, at each change
    streams: Mapping[str, Stream]
    channels: tuple[Channel, ...]  # Of the actuators; those without effect are only recorded
    findings: Findings  # Facts, assumptions and defects
    convention: str = "frd"  # Axes of the rates: ``frd`` or ``flu``
    # Accelerometer from the centre of gravity, m, FRD
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Stretches in the air, or armed; None if not logged
    flown: Stretches | None = None
    hovers: bool = False  # Whether it is a multirotor, or a VTOL with the commands of its hover
    ground_speed: float = 0.0  # Median ground speed in flight, m/s; 0 if unknown
    # Parameters of the autopilot that affect the identification, by name
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def used(self) -> list[tuple[int, Channel]]:
        """Column and channel of each actuator with an effect."""
        return [(i, c) for i, c in enumerate(self.channels) if any(c.effect)]

    @cached_property
    def has_force(self) -> bool:
        """Whether the log has specific force."""
        return bool(np.isfinite(self.streams["rates"].values[:, 3:]).any())

    def in_flight(self, name: str) -> BoolArray:
        """Return whether each sample of a stream lies in flight; all do if none is logged."""
        t_ns = self.streams[name].t_ns
        return inside(t_ns, self.flown) if self.flown else np.ones(len(t_ns), dtype=bool)

    def only_flight(self) -> FlightLog:
        """Return the log without the time on the ground."""
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
    """Return text from a file as one printable line of limited length."""
    line = "".join(character if character.isprintable() else "?" for character in text)
    return line if len(line) <= longest else f"{line[:longest]}..."
