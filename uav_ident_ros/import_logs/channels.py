# SPDX-License-Identifier: Apache-2.0
"""Effects of an autopilot's channels: weights in the inputs, ranges, mixers of rotors.

A positive de pitches down, dr yaws left, da rolls right, as in the whole package. The autopilots
count pitch up and yaw right as positive.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.import_logs.flight_log import Channel, Effect

PWM_MIN, PWM_TRIM, PWM_MAX = 1000.0, 1500.0, 2000.0
"""Default pulse widths of the least, rest and full command, us."""

SENSES = {"ccw": 1.0, "cw": -1.0}
"""Yawing moment per thrust, right positive, by the rotor's sense of rotation from above."""

ROTATION_RANGE = 2.0
"""Sum of the absolute weights of each of de, dr, da of a multirotor: at 1 half of the motors are
at full, the others at zero. As in config/px4_quadrotor.yaml."""


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
    rows = np.array([-right, forward, moment_ratios]) * thrust
    rows[np.abs(rows) < 1e-9 * max(np.abs(rows).max(), 1e-9)] = 0.0
    size = np.abs(rows).sum(axis=1, keepdims=True)
    rows = ROTATION_RANGE * np.divide(rows, size, out=np.zeros_like(rows), where=size > 0.0)
    names = ("roll", "pitch", "yaw", "thrust")
    columns = np.vstack([rows, thrust / thrust.sum()]).T.tolist()
    return [effect_of(dict(zip(names, column, strict=True))) for column in columns]


def over_range(
    channel: Channel,
    low: float,  # low, high: raw values at the ends of the range
    high: float,
    *,
    centre: float | None = None,  # Raw value at rest, of a two-sided channel
    turned: bool = False,  # Whether the direction is reversed
) -> Channel:
    """Return the channel with the scale of a range: zero to full, or two-sided about a centre.

    Raises
    ------
    ValueError
        If high is not above low.
    """
    if not high > low:
        raise ValueError(f"{channel.name} has the range {low:g} to {high:g}, which is empty")
    span, halves, rest = f"{low:g} to {high:g}", 1.0, high if turned else low
    if centre is not None:
        span, halves, rest = f"{low:g} {centre:g} {high:g}", 2.0, centre
    scale = (-halves if turned else halves) / (high - low)
    meaning = f"{channel.meaning}, {span} {channel.unit}{', reversed' if turned else ''}"
    return replace(channel, meaning=meaning, scale=scale, neutral=rest)


def named_once(channels: Sequence[Channel]) -> list[Channel]:
    """Return the channels with unique names: repeated ones end in ``_2``, ``_3`` ..."""
    names = [channel.name for channel in channels]
    counts = [names[: i + 1].count(name) for i, name in enumerate(names)]
    return [
        channel if count == 1 else replace(channel, name=f"{channel.name}_{count}")
        for channel, count in zip(channels, counts, strict=True)
    ]
