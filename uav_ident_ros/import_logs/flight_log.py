# SPDX-License-Identifier: Apache-2.0
"""Result of every reader of logs: streams of samples, and channels with their effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import BoolArray, FloatArray
from uav_ident_ros.import_logs.log import Log, LogStream
from uav_ident_ros.import_logs.stamps import Stretches, inside

Effect = tuple[float, float, float, float]
"""Share of a channel in de, dr, da, dth; see `Channel`. The autopilots count pitch up and yaw right
as positive."""

NO_EFFECT: Effect = (0.0, 0.0, 0.0, 0.0)

PWM_MIN, PWM_TRIM, PWM_MAX = 1000.0, 1500.0, 2000.0
"""Default pulse widths of the least, rest and full command, us."""

SENSES = {"ccw": 1.0, "cw": -1.0}
"""Yawing moment per thrust, right positive, by the rotor's sense of rotation from above."""

ROTATION_RANGE = 2.0
"""Sum of the absolute weights of each of de, dr, da of a multirotor: at 1 half of the motors are
at full, the others at zero. As in config/px4_quadrotor.yaml."""

LONGEST_LINE, LONGEST_TITLE = 2000, 120
"""Most characters of a message and of a title: damaged files have names of any length."""

TRIMS = ("flight", "neutral", "learn")
"""Sources of the trim: the median in flight, the channels' rest positions, or the identifier's
estimate from the first steady stretch."""


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

    def over_range(
        self,
        low: float,  # low, high: raw values at the ends of the range
        high: float,
        *,
        centre: float | None = None,  # Raw value at rest, of a two-sided channel
        turned: bool = False,  # Whether the direction is reversed
    ) -> Channel:
        """Return it with the scale of a range: zero to full, or two-sided about a centre."""
        if not high > low:
            raise ValueError(f"{self.name} has the range {low:g} to {high:g}, which is empty")
        span, halves, rest = f"{low:g} to {high:g}", 1.0, high if turned else low
        if centre is not None:
            span, halves, rest = f"{low:g} {centre:g} {high:g}", 2.0, centre
        scale = (-halves if turned else halves) / (high - low)
        meaning = f"{self.meaning}, {span} {self.unit}{', reversed' if turned else ''}"
        return replace(self, meaning=meaning, scale=scale, neutral=rest)


def named_once(channels: Sequence[Channel]) -> list[Channel]:
    """Return the channels with unique names: repeated ones end in ``_2``, ``_3`` ..."""
    names = [channel.name for channel in channels]
    counts = [names[: i + 1].count(name) for i, name in enumerate(names)]
    return [
        channel if count == 1 else replace(channel, name=f"{channel.name}_{count}")
        for channel, count in zip(channels, counts, strict=True)
    ]


def effect_of(entry: Mapping[str, Any], share: float = 1.0) -> Effect:
    """Return the effect of an entry of shares in roll right, pitch up, yaw right and thrust."""
    roll, pitch, yaw, thrust = (
        float(entry.get(axis, 0.0)) * share for axis in ("roll", "pitch", "yaw", "thrust")
    )
    return (0.0 - pitch, 0.0 - yaw, roll + 0.0, thrust)  # never -0.0


def effects_of_arms(arms: Sequence[str]) -> list[Effect]:
    """Return the effects of equal rotors, each given as its arm's angle and sense of rotation.

    The angle is clockwise from the nose, deg. A third field is the share in yaw, 1 by default.
    """
    angles, senses, shares = zip(*([*arm.split(), "1"][:3] for arm in arms), strict=True)
    bearings = np.radians(np.array(angles, dtype=float))
    positions = np.column_stack([np.cos(bearings), np.sin(bearings)])
    yawing = [SENSES[sense] * float(share) for sense, share in zip(senses, shares, strict=True)]
    return rotor_effects(positions, yawing, [1.0] * len(arms))


def rotor_effects(
    positions: FloatArray,  # (N, 2) Forward and right of the centre, in any unit
    # Yawing moment per thrust: positive for a rotor that turns counter-clockwise from above, whose
    # reaction yaws the vehicle right
    moment_ratios: Sequence[float],
    thrusts: Sequence[float],  # Relative thrust at full command
) -> list[Effect]:
    """Return the effects of upward rotors; the weights of each rotation sum to `ROTATION_RANGE`."""
    thrust = np.asarray(thrusts, dtype=float)
    forward, right = positions.T
    rows = np.array([-forward, -np.asarray(moment_ratios), -right]) * thrust
    rows[np.abs(rows) < 1e-9 * max(np.abs(rows).max(), 1e-9)] = 0.0
    size = np.abs(rows).sum(axis=1, keepdims=True)
    rows = ROTATION_RANGE * np.divide(rows, size, out=np.zeros_like(rows), where=size > 0.0)
    columns = np.vstack([rows + 0.0, thrust / thrust.sum()]).T  # never -0.0
    return [(de, dr, da, dth) for de, dr, da, dth in columns.tolist()]


@dataclass(frozen=True, eq=False)
class FlightLog:
    """A log in the units, axes and names of this package."""

    log: Log  # The messages that it was made from, and the findings about them
    # By name; rates and actuators are always present:
    # rates      (n, 6) Angular velocity, rad/s, and specific force, m/s^2, NaN where there is none
    # actuators  (n, C) Raw values of every logged channel, valid from the stamp on
    # airspeed   (n,) True airspeed, m/s
    # attitude   (n, 4) Unit quaternions x, y, z, w from body axes (FRD) to north-east-down
    # setpoint   (n, 3) Rates requested by the autopilot, rad/s, FRD
    # mode       (n,) Name of the autopilot's mode, at each change
    streams: Mapping[str, LogStream]
    channels: tuple[Channel, ...]  # Of the actuators; those without effect are only recorded
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
            raise self.log.refusal(f": {reason}: leave --flight-only out")
        self.log.findings.lost.append("what was logged on the ground is left out (--flight-only)")
        streams = {name: s.chosen(self.in_flight(name)) for name, s in self.streams.items()}
        for name in ("rates", "actuators"):
            if not len(streams[name].t_ns):
                raise self.log.refusal(f" has no {name} in flight: leave --flight-only out")
        return replace(self, streams=streams)


def printable(text: str, longest: int = LONGEST_LINE) -> str:
    """Return text from a file as one printable line of limited length."""
    line = "".join(character if character.isprintable() else "?" for character in text)
    return line if len(line) <= longest else f"{line[:longest]}..."
