# SPDX-License-Identifier: Apache-2.0
"""Input streams of the node and of a replay: topic, types, reader and destination of each."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from uav_ident_ros.identification import samples
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages import types
from uav_ident_ros.messages.types import EXCITATION_TYPE, ActuatorReader, RatesReader, Reading


@dataclass(frozen=True)
class Stream:
    """One input stream."""

    name: str  # Name in the identifier
    topic: str  # The node's topic, relative as in ``-r imu/data:=...``
    setting: str  # Setting of the message type; empty if there is only one type
    types: Collection[str]  # Supported types
    # Makes a reader by the settings: message to stamp (ns) and values, or a `ChannelError`
    reader: Callable[[Settings], Callable[[Any], Reading]]
    # Adds the values of a stamp (ns) to an identifier; returns the reason of a drop, or None
    add: Callable[[OnlineIdentifier, int, Any], samples.Drop | None]
    # Whether it is read only if its type is set or its topic chosen; with a single type, if the
    # topic exists
    optional: bool = False
    # Whether its stamps may be missing or have another time base (see `feed.Feed`)
    any_clock: bool = False

    def type_of(self, settings: Settings) -> str:
        """Return the message type; empty for an optional stream whose type is not set."""
        return str(settings.values()[self.setting]) if self.setting else next(iter(self.types))


STREAMS = (
    Stream(
        samples.RATES_STREAM,
        "imu/data",
        "imu.type",
        types.RATE_ADAPTERS,
        lambda settings: RatesReader(settings.imu),
        lambda identifier, t_ns, values: identifier.add_rates(t_ns, *values),
    ),
    Stream(
        samples.ACTUATORS,
        "actuators",
        "actuators.type",
        types.ACTUATOR_ADAPTERS,
        lambda settings: ActuatorReader(settings.actuators),
        OnlineIdentifier.add_actuators,
    ),
    Stream(
        samples.AIRSPEED,
        "airspeed",
        "airspeed.type",
        types.AIRSPEED_READERS,
        lambda settings: types.AIRSPEED_READERS[settings.airspeed.type],
        OnlineIdentifier.add_airspeed,
        optional=True,
        any_clock=True,
    ),
    Stream(
        samples.ARMED,
        "armed",
        "armed.type",
        types.ARMED_READERS,
        lambda settings: types.ARMED_READERS[settings.armed.type],
        OnlineIdentifier.add_armed,
        optional=True,
        any_clock=True,
    ),
    Stream(
        samples.EXCITATION,
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
"""End of the topics of injected signals: the input, and the node's own, which a controller adds to
its commands."""

OWN_TOPICS = ("/coefficients", "/coefficients_named", EXCITATION_END)
"""Ends of the node's own topics with a type of actuator messages: a bag may contain them."""
