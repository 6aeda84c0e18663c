# SPDX-License-Identifier: Apache-2.0
"""The messages of a bag into an identifier, in log-time order, as the node takes them in flight.

Imu messages that are all alike, and that is nearly all of them, are read as arrays; the others, and
all other messages, one by one. What the identifier is told is the same.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.bags.reading import Bag, BagError, Message
from uav_ident_ros.identification.identifier import (
    ACTUATORS,
    AIRSPEED,
    ARMED,
    EXCITATION,
    RATES,
    OnlineIdentifier,
)
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.messages.airspeed import AIRSPEED as AIRSPEED_READERS
from uav_ident_ros.messages.armed import ARMED as ARMED_READERS
from uav_ident_ros.messages.arrival import Arrivals
from uav_ident_ros.messages.cdr import ChannelsDecoder
from uav_ident_ros.messages.excitation import read_excitation
from uav_ident_ros.messages.types import (
    RATES as RATES_READERS,
)
from uav_ident_ros.messages.types import (
    ActuatorReader,
    ActuatorReading,
    ChannelError,
    RatesReading,
    decode_imu_cdr,
    frame_fault,
)
from uav_ident_ros.offline.imu_block import ImuBlock, decode_imu_block
from uav_ident_ros.offline.inputs import Inputs

IMU_TYPE = "sensor_msgs/msg/Imu"

# Why the shells refuse a message before the identifier sees it.
WRONG_FRAME, NO_RATES, UNREADABLE = "wrong frame", "no rates", "unreadable"
NOT_FINITE, WRONG_CHANNELS = "not finite", "wrong channels"

_NO_FORCE = (0.0, 0.0, 0.0)


class Record:
    """Samples of one stream as the identifier took them.

    Parameters
    ----------
    width : int
        Values per sample.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._t = array("q")
        self._values = array("d")
        self._era = array("q")

    def __len__(self) -> int:
        return len(self._t)

    def append(self, t_ns: int, values: Iterable[float], era: int) -> None:
        """Keep a sample; `era` counts the restarts of the time base before it."""
        self._t.append(t_ns)
        self._values.extend(values)
        self._era.append(era)

    def extend(self, t_ns: TimeArray, values: FloatArray, era: int) -> None:
        """Keep samples: stamps (k,), values (k, width)."""
        self._t.frombytes(t_ns.tobytes())
        self._values.frombytes(values.tobytes())
        self._era.extend([era] * len(t_ns))

    def of_era(self, era: int) -> tuple[TimeArray, FloatArray]:
        """Return stamps (k,), strictly rising, and values (k, width) of one time base."""
        chosen = np.array(self._era) == era
        values = np.array(self._values).reshape(-1, self._width)[chosen]
        t_ns = np.array(self._t, dtype=np.int64)[chosen]
        if (t_ns[1:] > t_ns[:-1]).all():
            return t_ns, values
        t_ns, first = np.unique(t_ns, return_index=True)
        return t_ns, values[first]


@dataclass(frozen=True)
class Refusals:
    """Messages of one stream and what became of them."""

    received: int  # Messages read
    dropped: dict[str, int]  # How many of them were not used, for each reason


class Intake:
    """Takes the messages of a bag.

    Parameters
    ----------
    inputs : Inputs
        Topics and settings.
    identifier : OnlineIdentifier
        Who gets the samples.

    Attributes
    ----------
    rates, actuators : Record
        Samples that were taken, in the sensor's axes and as raw channels.
    injected : Record
        Excitation that was taken: de, dr, da, dth.
    era : int
        Restarts of the time base so far.
    frame_id : str or None
        Newest frame of the rates.
    frame_ids : set of str
        Every frame they have come in.
    fault : str
        How their axes contradict the settings; empty if they do not.
    """

    def __init__(self, inputs: Inputs, identifier: OnlineIdentifier) -> None:
        settings = inputs.settings
        self._inputs = inputs
        self._identifier = identifier
        self._read_rates = RATES_READERS[settings.imu.type].read
        self._read_channels = ActuatorReader(settings.actuators)
        self._read_bytes: Callable[[bytes], ActuatorReading | None] = lambda data: None
        if ChannelsDecoder.knows(settings.actuators.type, self._read_channels.field):
            self._read_bytes = ChannelsDecoder(settings.actuators.type, self._read_channels.field)
        self.rates = Record(6)
        self.actuators = Record(len(settings.actuators.channels))
        self.injected = Record(len(INPUTS))
        self.era = 0
        self.frame_id: str | None = None
        self.frame_ids: set[str] = set()
        self.fault = ""
        self._newest_ns: int | None = None
        self._jump_ns = round(settings.time_jump * 1e9)
        self._received: Counter[str] = Counter()
        self._refused: dict[str, Counter[str]] = {s: Counter() for s in identifier.drops}
        self._stream_of = {topic: stream for stream, topic in inputs.streams.items()}
        self._airspeeds = Arrivals(identifier, identifier.add_airspeed)
        self._armings = Arrivals(identifier, identifier.add_armed)
        self._take = {
            RATES: self._take_rates,
            ACTUATORS: self._take_actuators,
            AIRSPEED: self._take_airspeed,
            ARMED: self._take_armed,
            EXCITATION: self._take_excitation,
        }
        self._decode: dict[str, Callable[[bytes], object]] = {}

    def read_with(self, bag: Bag) -> None:
        """Read the messages that follow by the definitions in a bag.

        Raises
        ------
        BagError
            If a topic is missing, or its type unknown.
        """
        self._decode = {
            stream: bag.decoder(topic) for stream, topic in self._inputs.streams.items()
        }

    def refusals(self, stream: str) -> Refusals:
        """Count what became of the messages of a stream."""
        dropped = Counter(self._refused[stream])
        for drop, count in self._identifier.drops[stream].items():
            dropped[drop.value] += count
        kept = {reason: count for reason, count in sorted(dropped.items()) if count > 0}
        return Refusals(self._received[stream], kept)

    def take(self, messages: Sequence[Message], tick: Callable[[], None]) -> None:
        """Take messages in their order; `tick` is called whenever ticks may have come due."""
        imu = [i for i, m in enumerate(messages) if m.topic == self._inputs.rates_topic]
        block = self._block([messages[i].data for i in imu])
        if block is None:
            for message in messages:
                self._take_one(message)
                tick()
            return
        self._received[RATES] += len(imu)
        self.rates.extend(block.t_ns, block.values, self.era)
        self._newest_ns = int(block.t_ns[-1])
        stamps, values = block.t_ns.tolist(), block.values.tolist()
        taken = begin = 0
        for place in [*_others(len(messages), imu), len(messages)]:
            # the rates that were logged before this other message
            end = begin + place - taken
            self._take_orderly(stamps, values, begin, end, tick)
            if place < len(messages):
                self._take_one(messages[place])
            begin, taken = end, place + 1

    def _block(self, data: list[bytes]) -> ImuBlock | None:
        """Read rates at one go, if there is nothing about them to look at one by one."""
        if self._inputs.settings.imu.type != IMU_TYPE or not data:
            return None
        block = decode_imu_block(data)
        if block is None or block.frame_id != self.frame_id or self.fault:
            return None
        return block if self._identifier.orderly(block.t_ns, block.values) else None

    def _take_orderly(
        self,
        stamps: list[int],
        values: list[list[float]],
        begin: int,
        end: int,
        tick: Callable[[], None],
    ) -> None:
        """Take samples `begin` to `end` of a block, with a halt at each that makes a tick due."""
        add = self._identifier.add_orderly_rates
        while begin < end:
            due_ns = self._identifier.next_due_ns
            stop = min(bisect_left(stamps, due_ns, begin, end) + 1, end)
            add(stamps[begin:stop], values[begin:stop])
            if stamps[stop - 1] >= due_ns:
                tick()
            begin = stop

    def _take_one(self, message: Message) -> None:
        """Take one message of any stream."""
        stream = self._stream_of[message.topic]
        self._received[stream] += 1
        try:
            self._take[stream](message)
        except BagError:
            self._refused[stream][UNREADABLE] += 1

    def _take_rates(self, message: Message) -> None:
        reading: RatesReading | None = None
        if self._inputs.settings.imu.type == IMU_TYPE:
            reading = decode_imu_cdr(message.data)
        t_ns, rates, force, frame_id = reading or self._read_rates(
            self._decode[RATES](message.data)
        )
        if frame_id != self.frame_id:
            self.frame_id = frame_id
            self.frame_ids.add(frame_id)
            imu = self._inputs.settings.imu
            self.fault = frame_fault(imu.convention, frame_id, imu.type)
        if self.fault:
            self._refused[RATES][WRONG_FRAME] += 1
        elif rates is None:
            self._refused[RATES][NO_RATES] += 1
        elif self._identifier.add_rates(t_ns, rates, force) is None:
            if self._newest_ns is not None and abs(t_ns - self._newest_ns) > self._jump_ns:
                self.era += 1
                self._newest_ns = t_ns
            self._newest_ns = max(t_ns, self._newest_ns or t_ns)
            self.rates.append(t_ns, (*rates, *(force or _NO_FORCE)), self.era)
            self._airspeeds.settle()
            self._armings.settle()

    def _take_actuators(self, message: Message) -> None:
        read = self._read_channels
        reading = self._read_bytes(message.data)
        try:
            if reading is not None:
                stamp_ns, values = read.select(reading)
            else:
                stamp_ns, values = read(self._decode[ACTUATORS](message.data))
        except ChannelError as error:
            reason = NOT_FINITE if error.not_finite else WRONG_CHANNELS
            self._refused[ACTUATORS][reason] += 1
            return
        t_ns = message.log_ns if stamp_ns is None else stamp_ns
        if self._identifier.add_actuators(t_ns, values) is None:
            self.actuators.append(t_ns, values, self.era)

    def _take_airspeed(self, message: Message) -> None:
        read = AIRSPEED_READERS[self._inputs.settings.airspeed.type]
        stamp_ns, airspeed = read(self._decode[AIRSPEED](message.data))
        self._airspeeds.add(stamp_ns, message.log_ns, airspeed)

    def _take_armed(self, message: Message) -> None:
        read = ARMED_READERS[self._inputs.settings.armed.type]
        stamp_ns, armed = read(self._decode[ARMED](message.data))
        self._armings.add(stamp_ns, message.log_ns, armed)

    def _take_excitation(self, message: Message) -> None:
        try:
            t_ns, values = read_excitation(self._decode[EXCITATION](message.data))
        except ChannelError as error:
            reason = NOT_FINITE if error.not_finite else WRONG_CHANNELS
            self._refused[EXCITATION][reason] += 1
            return
        if self._identifier.add_excitation(t_ns, values) is None:
            self.injected.append(t_ns, values, self.era)


def _others(count: int, chosen: Sequence[int]) -> list[int]:
    """Return the numbers below `count` that are not among the chosen ones."""
    flags = np.ones(count, dtype=bool)
    flags[chosen] = False
    return [int(i) for i in np.flatnonzero(flags)]
