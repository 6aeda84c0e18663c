# SPDX-License-Identifier: Apache-2.0
"""The node's inputs in a bag: which topics they are, and their messages into an identifier.

Topics are asked for, or found by name and type. Messages are taken in log-time order, as the node
takes them in flight.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from uav_ident_ros.bags.reading import Bag, BagError, Message
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ACTUATORS, EXCITATION, NS, RATES, TimeArray
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.messages.feed import Feed
from uav_ident_ros.messages.streams import EXCITATION_END, OWN_TOPICS, STREAMS, Stream
from uav_ident_ros.messages.types import EXCITATION_TYPE, ChannelError


@dataclass(frozen=True)
class Inputs:
    """Which topics of a bag to read, and the settings that fit their types."""

    streams: Mapping[str, str]  # topic of every stream that is read, by the stream's name
    settings: Settings  # their message types are those of the topics

    @property
    def topics(self) -> tuple[str, ...]:
        """Every topic that is read."""
        return tuple(self.streams.values())


def choose_inputs(
    bag: Bag,
    # Parameters by dotted name; a message type that is not among them is the topic's
    parameters: Mapping[str, object],
    # Topics to take, by stream as in `STREAMS`. Rates and actuators left out: ``/imu/data`` and
    # ``/actuators`` if the bag has them, else the only topic of a known type. Airspeed and armed:
    # none, or, if the type is set, ``/airspeed`` and ``/armed`` or else the only topic of that
    # type. Excitation: ``/excitation``, or else the only one whose name ends so
    requested: Mapping[str, str] | None = None,
) -> Inputs:
    """Find the input topics of a bag.

    Raises
    ------
    BagError
        If a topic is missing, not of a usable type, or there are several to choose from.
    SettingsError
        If a parameter is wrong.
    """
    values = dict(parameters)
    Settings.from_values(values)  # what is wrong with the parameters comes before the bag
    topics = {}
    for stream in STREAMS:
        topic = (requested or {}).get(stream.name)
        if not stream.setting:
            topics[stream.name] = _choose(bag, stream, topic, "") if topic else _find_injected(bag)
            continue
        wanted = str(values.get(stream.setting) or "")
        if topic or wanted or not stream.optional:
            topics[stream.name] = _choose(bag, stream, topic, wanted)
            values[stream.setting] = bag.type_of(topics[stream.name])
    read = {name: topic for name, topic in topics.items() if topic}
    return Inputs(read, Settings.from_values(values))


def _find_injected(bag: Bag) -> str:
    """Return the topic of what was injected; empty if the bag has none, or several."""
    of_type = (topic for topic, kind in bag.types.items() if kind == EXCITATION_TYPE)
    ends = [topic for topic in of_type if topic.endswith(EXCITATION_END)]
    if EXCITATION_END in ends:
        return EXCITATION_END
    return ends[0] if len(ends) == 1 else ""


def _choose(bag: Bag, stream: Stream, requested: str | None, wanted: str) -> str:
    """Return the topic asked for, or else the one to be found, if its type will do."""
    types = (wanted,) if wanted else stream.types
    topic = requested or _find_topic(bag, stream, types)
    msgtype = bag.type_of(topic)
    if msgtype not in types:
        known = ", ".join(stream.types)
        reason = f"'{stream.setting}' is '{wanted}'" if wanted else f"known are {known}"
        raise BagError(f"bag '{bag.path}': topic '{topic}' is of type {msgtype}, but {reason}")
    return topic


def _find_topic(bag: Bag, stream: Stream, types: tuple[str, ...]) -> str:
    """Return the topic of the stream's own name, or the only one of the given types."""
    default = f"/{stream.topic}"
    if default in bag.types:
        return default
    found = candidates(bag, types)
    if not found:
        raise BagError(
            f"bag '{bag.path}' has neither a topic '{default}' nor one of type "
            f"{' or '.join(types)}; it has {bag.contents()}"
        )
    if len(found) > 1:
        listed = "".join(f"\n  {_described(bag, topic)}" for topic in found)
        raise BagError(
            f"bag '{bag.path}' has no topic '{default}', but {len(found)} that could be it: "
            f"choose one with --topic {stream.topic}:={found[0]}{listed}"
        )
    return found[0]


def candidates(bag: Bag, types: tuple[str, ...]) -> list[str]:
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


# --- their messages into an identifier ------------------------------------------------------------


UNREADABLE = "unreadable"
"""Why a message is refused whose bytes are none of its type."""

_NO_FORCE = (0.0, 0.0, 0.0)


class Record:
    """Samples of one stream as the identifier took them, by their time base."""

    def __init__(
        self,
        width: int,  # Values per sample
    ) -> None:
        self._width = width
        self._t: dict[int, array[int]] = defaultdict(lambda: array("q"))
        self._values: dict[int, array[float]] = defaultdict(lambda: array("d"))

    def __len__(self) -> int:
        return sum(map(len, self._t.values()))

    def append(self, t_ns: int, values: Iterable[float], era: int) -> None:
        """Keep a sample; `era` counts the restarts of the time base before it."""
        self._t[era].append(t_ns)
        self._values[era].extend(values)

    def of_era(self, era: int) -> tuple[TimeArray, FloatArray]:
        """Return stamps (k,), strictly rising, and values (k, width) of one time base.

        They may be those of the record itself: while they are in use, nothing can be added.
        """
        t_ns = np.frombuffer(self._t[era], np.int64)
        values = np.frombuffer(self._values[era]).reshape(-1, self._width)
        if (t_ns[1:] > t_ns[:-1]).all():
            return t_ns, values
        t_ns, first = np.unique(t_ns, return_index=True)
        return t_ns, values[first]


@dataclass(frozen=True)
class Refusals:
    """Messages of one stream and what became of them."""

    received: int  # Messages read
    dropped: dict[str, int]  # How many of them were not used, for each reason

    @property
    def words(self) -> str:
        """What was dropped, and why."""
        return ", ".join(f"{count} {reason}" for reason, count in self.dropped.items())


class Intake:
    """Takes the messages of a bag."""

    def __init__(self, inputs: Inputs, identifier: OnlineIdentifier) -> None:
        settings = inputs.settings
        self._inputs, self._identifier = inputs, identifier
        self._feeds = {
            stream.name: Feed(stream, identifier, partial(self._decoded, stream.name))
            for stream in STREAMS
            if stream.name in inputs.streams
        }
        self._stream_of = {topic: stream for stream, topic in inputs.streams.items()}
        self._decoders: dict[str, Callable[[bytes], object]] = {}
        # What was taken: in the sensor's axes, as raw channels, and de, dr, da, dth of excitation
        self.rates = Record(6)
        self.actuators = Record(len(settings.actuators.channels))
        self.injected = Record(len(INPUTS))
        self._records = {ACTUATORS: self.actuators, EXCITATION: self.injected}
        self.era = 0  # Restarts of the time base so far
        self.frame_ids: set[str] = set()  # Every frame the rates have come in
        self._newest_ns: int | None = None
        self._jump_ns = round(settings.time_jump * 1e9)

    @property
    def frame_id(self) -> str | None:
        """Newest frame of the rates."""
        frame_id: str | None = self._feeds[RATES].reader.frame_id
        return frame_id

    @property
    def fault(self) -> str:
        """How their axes contradict the settings; empty if they do not."""
        return str(self._feeds[RATES].reader.fault) if self._feeds[RATES].received else ""

    def read_with(self, bag: Bag) -> None:
        """Read the messages that follow by the definitions in a bag.

        Raises
        ------
        BagError
            If a topic is missing, or its type unknown.
        """
        topics = self._inputs.streams.items()
        self._decoders = {stream: bag.decoder(topic) for stream, topic in topics}

    def _decoded(self, stream: str, data: bytes) -> object:
        try:
            return self._decoders[stream](data)
        except BagError as error:
            raise ChannelError(str(error), UNREADABLE) from None

    def refusals(self, stream: str) -> Refusals:
        """Count what became of the messages of a stream."""
        if stream not in self._feeds:
            return Refusals(0, {})
        feed = self._feeds[stream]
        return Refusals(feed.received, {reason: n for reason, n in sorted(feed.drops().items())})

    def take(self, message: Message) -> None:
        """Take the next message; ticks may come due with it."""
        stream = self._stream_of[message.topic]
        taken = self._feeds[stream].take(message.data, message.log_ns)
        if stream == RATES and self.frame_id is not None:
            self.frame_ids.add(self.frame_id)
        if taken is None:
            return
        if stream == RATES:
            self._keep_rates(*taken)
        elif stream in self._records:
            t_ns, values = taken
            self._records[stream].append(t_ns, values, self.era)

    def _keep_rates(self, t_ns: int, values: Any) -> None:
        if self._newest_ns is not None and abs(t_ns - self._newest_ns) > self._jump_ns:
            self.era += 1
            self._newest_ns = t_ns
        self._newest_ns = max(t_ns, self._newest_ns or t_ns)
        rates, force = values
        self.rates.append(t_ns, (*rates, *(force or _NO_FORCE)), self.era)
        for feed in self._feeds.values():
            feed.settle()
