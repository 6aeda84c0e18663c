# SPDX-License-Identifier: Apache-2.0
"""The node's inputs in a bag: topics that are requested, or found by name and type."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from uav_ident_ros.bags.reading import Bag, BagError
from uav_ident_ros.identification.samples import EXCITATION, NS
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages.streams import EXCITATION_END, OWN_TOPICS, STREAMS, Stream
from uav_ident_ros.messages.types import EXCITATION_TYPE


@dataclass(frozen=True)
class BagInputs:
    """Topics of a bag to read, and the settings with their types."""

    streams: Mapping[str, str]  # Topic of every stream that is read, by the stream's name
    settings: Settings  # Settings, with the message types of the topics

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that are read."""
        return tuple(self.streams.values())


def choose_inputs(
    bag: Bag,
    # Parameters by dotted name; a message type that is not set is taken from the topic
    parameters: Mapping[str, object],
    # Requested topics, by stream as in `STREAMS`. Defaults: for rates and actuators ``/imu/data``
    # and ``/actuators``, else the only topic of a known type. For airspeed and armed none, or, if
    # the type is set, ``/airspeed`` and ``/armed``, else the only topic of that type. For
    # excitation ``/excitation``, else the only topic whose name ends so
    requested: Mapping[str, str] | None = None,
) -> BagInputs:
    """Find the input topics of a bag.

    Raises `BagError` if a topic is missing, not of a usable type, or there are several to choose
    from, and `SettingsError` if a parameter is wrong.
    """
    values = dict(parameters)
    Settings.from_values(values)  # errors of the parameters come before those of the bag
    requested = {EXCITATION: _find_injected(bag), **(requested or {})}
    topics = {}
    for stream in STREAMS:
        topic, wanted = requested.get(stream.name), str(values.get(stream.setting) or "")
        if topic or wanted or not stream.optional:
            topics[stream.name] = _choose(bag, stream, topic, wanted)
            if stream.setting:
                values[stream.setting] = bag.type_of(topics[stream.name])
    return BagInputs(topics, Settings.from_values(values))


def _find_injected(bag: Bag) -> str:
    """Return the topic of the injected signals; empty if the bag has none, or several."""
    of_type = (topic for topic, kind in bag.types.items() if kind == EXCITATION_TYPE)
    ends = [topic for topic in of_type if topic.endswith(EXCITATION_END)]
    if EXCITATION_END in ends:
        return EXCITATION_END
    return ends[0] if len(ends) == 1 else ""


def _choose(bag: Bag, stream: Stream, requested: str | None, wanted: str) -> str:
    """Return the requested topic, or else the one found; raise if its type is not usable."""
    types = (wanted,) if wanted else stream.types
    topic = requested or _find_topic(bag, stream, types)
    msgtype = bag.type_of(topic)
    if msgtype not in types:
        known = f"'{stream.topic}' may be {', '.join(stream.types)}"
        reason = f"'{stream.setting}' is '{wanted}'" if wanted else known
        raise BagError(f"bag '{bag.path}': topic '{topic}' is of type {msgtype}, but {reason}")
    return topic


def _find_topic(bag: Bag, stream: Stream, types: Collection[str]) -> str:
    """Return the topic of the stream's own name, or the only one of the given types."""
    default = f"/{stream.topic}"
    if default in bag.types:
        return default
    found = candidates(bag, types)
    if not found:
        cure = f"record one, or leave '{stream.setting}' empty" if stream.optional else "record one"
        raise BagError(
            f"bag '{bag.path}' has neither a topic '{default}' nor one of type "
            f"{' or '.join(types)}; it has {bag.contents()}: {cure}"
        )
    if len(found) > 1:
        listed = "".join(f"\n  {_described(bag, topic)}" for topic in found)
        raise BagError(
            f"bag '{bag.path}' has no topic '{default}', but {len(found)} that could be it: "
            f"choose one with --topic {stream.topic}:={found[0]}{listed}"
        )
    return found[0]


def candidates(bag: Bag, types: Collection[str]) -> list[str]:
    """Return the topics of some types; those without messages only if there are no others."""
    found = [
        topic
        for topic, msgtype in bag.types.items()
        if msgtype in types and not topic.endswith(OWN_TOPICS)
    ]
    return [topic for topic in found if bag.counts[topic]] or found


def _described(bag: Bag, topic: str) -> str:
    count = bag.counts[topic]
    seconds = (bag.end_ns - bag.start_ns) * NS
    rate = f", {count / seconds:.0f} Hz" if seconds > 0.0 else ""
    return f"{topic} ({bag.types[topic]}), {count} messages{rate}"
