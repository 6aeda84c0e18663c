# SPDX-License-Identifier: Apache-2.0
"""The node's inputs as streams of a bag: names, topics, message types."""

from __future__ import annotations

from dataclasses import dataclass

from uav_ident_ros.identification.identifier import (
    ACTUATORS,
    AIRSPEED,
    ARMED,
    EXCITATION,
    RATES,
)
from uav_ident_ros.identification.settings import (
    ACTUATOR_TYPES,
    AIRSPEED_TYPES,
    ARMED_TYPES,
    RATE_TYPES,
)
from uav_ident_ros.messages.excitation import EXCITATION_TYPE


@dataclass(frozen=True)
class Stream:
    """One of the node's inputs."""

    name: str  # What the identifier calls it
    topic: str  # The node's topic, relative as in ``-r imu/data:=...``
    setting: str  # Setting that holds its message type; empty if there is but one type
    types: tuple[str, ...]  # Types that can be read
    # Whether it is read only if its type is set, or its topic asked for; where there is but one
    # type, if it is there
    optional: bool = False


STREAMS = (
    Stream(RATES, "imu/data", "imu.type", RATE_TYPES),
    Stream(ACTUATORS, "actuators", "actuators.type", ACTUATOR_TYPES),
    Stream(AIRSPEED, "airspeed", "airspeed.type", AIRSPEED_TYPES, optional=True),
    Stream(ARMED, "armed", "armed.type", ARMED_TYPES, optional=True),
    Stream(EXCITATION, "excitation", "", (EXCITATION_TYPE,), optional=True),
)
"""The node's inputs."""

EXCITATION_END = "/excitation"
"""End of the topics of what was injected on purpose: of the input, and of the node's own, which a
controller adds."""

OWN_TOPICS = ("/coefficients", "/coefficients_named", EXCITATION_END)
"""Ends of the node's own topics, which have the types of actuators: a bag may hold them, too."""
