# SPDX-License-Identifier: Apache-2.0
"""What autopilots' parameters mean: the YAML tables of this folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import yaml

from uav_ident_ros.import_logs.flight_log import Effect
from uav_ident_ros.import_logs.mixing import from_torques, on_a_circle, rotor_effects

SENSES = {"ccw": 1.0, "cw": -1.0}
"""Yawing moment per thrust, right positive, by the rotor's sense of rotation from above."""


@cache
def table(name: str) -> dict[Any, Any]:
    """Return the table of this name."""
    file = resources.files(__package__).joinpath(f"{name}.yaml")
    return dict(yaml.safe_load(file.read_text(encoding="utf-8")))


def effect_of(entry: Mapping[str, Any], share: float = 1.0) -> Effect:
    """Return the effect of an entry with shares in roll, pitch, yaw and thrust."""
    roll, pitch, yaw, thrust = (
        float(entry.get(axis, 0.0)) * share for axis in ("roll", "pitch", "yaw", "thrust")
    )
    return from_torques(roll, pitch, yaw, thrust)


def effects_of_arms(arms: Sequence[str]) -> list[Effect]:
    """Return the effects of equal rotors, each given as its arm's angle and sense of rotation."""
    angles, senses = zip(*(arm.split() for arm in arms), strict=True)
    moments = [SENSES[sense] for sense in senses]
    return rotor_effects(on_a_circle([float(a) for a in angles]), moments, [1.0] * len(arms))
