# SPDX-License-Identifier: Apache-2.0
"""The inputs of the node and of a replay: one row a stream, from its topic to the identifier."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ACTUATORS, AIRSPEED, ARMED, EXCITATION, RATES, Drop
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages import types
from uav_ident_ros.messages.types import EXCITATION_TYPE, ActuatorReader, RatesReader, Reading


@dataclass(frozen=True)
class Stream:
    """One of the inputs."""

    name: str  # What the identifier calls it
    topic: str  # The node's topic, relative as in ``-r imu/data:=...``
    setting: str  # Setting that holds its message type; empty if there is but one type
    types: tuple[str, ...]  # Types that can be read
    # Settings to a reader: message to stamp, ns, and values; it may raise `ChannelError`
    reader: Callable[[Settings], Callable[[Any], Reading]]
    # Gives an identifier the values of a stamp, ns; returns why it dropped them, or None
    add: Callable[[OnlineIdentifier, int, Any], Drop | None]
    # Whether it is read only if its type is set, or its topic asked for; where there is but one
    # type, if it is there
    optional: bool = False
    # Whether it may carry no time, or that of any clock (see `feed.Feed`)
    any_clock: bool = False

    def type_of(self, settings: Settings) -> str:
        """Return the message type; empty for an optional stream whose type is not set."""
        return str(settings.values()[self.setting]) if self.setting else self.types[0]


STREAMS = (
    Stream(
        RATES,
        "imu/data",
        "imu.type",
        tuple(types.RATES),
        lambda settings: RatesReader(settings.imu),
        lambda identifier, t_ns, values: identifier.add_rates(t_ns, *values),
    ),
    Stream(
        ACTUATORS,
        "actuators",
        "actuators.type",
        tuple(types.ACTUATORS),
        lambda settings: ActuatorReader(settings.actuators),
        OnlineIdentifier.add_actuators,
    ),
    Stream(
        AIRSPEED,
        "airspeed",
        "airspeed.type",
        tuple(types.AIRSPEEDS),
        lambda settings: types.AIRSPEEDS[settings.airspeed.type],
        OnlineIdentifier.add_airspeed,
        optional=True,
        any_clock=True,
    ),
    Stream(
        ARMED,
        "armed",
        "armed.type",
        tuple(types.ARMINGS),
        lambda settings: types.ARMINGS[settings.armed.type],
        OnlineIdentifier.add_armed,
        optional=True,
        any_clock=True,
    ),
    Stream(
        EXCITATION,
        "excitation",
        "",
        (EXCITATION_TYPE,),
        lambda settings: types.read_excitation,
        OnlineIdentifier.add_excitation,
        optional=True,
    ),
)
"""The inputs."""

EXCITATION_END = "/excitation"
"""End of the topics of what was injected on purpose: of the input, and of the node's own, which a
controller adds."""

OWN_TOPICS = ("/coefficients", "/coefficients_named", EXCITATION_END)
"""Ends of the node's own topics, which have the types of actuators: a bag may hold them, too."""
