# SPDX-License-Identifier: Apache-2.0
"""The pipeline over a bag: what the node would have published in flight, and how good it was.

There is no estimation logic here: messages go in by log time, due ticks are asked for.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from uav_ident_ros.airspeed import AIRSPEED
from uav_ident_ros.bags import Bag, BagError, Message
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.frames import BodyFrame
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.prediction import (
    InputSignal,
    PredictionFit,
    WindowErrors,
    score_windows,
    window_errors,
)
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.sampling import Block, Sampler
from uav_ident_ros.identification.settings import (
    ACTUATOR_TYPES,
    AIRSPEED_TYPES,
    RATE_TYPES,
    Settings,
)
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages import (
    RATES,
    ActuatorReader,
    ChannelError,
    RatesReading,
    decode_imu_cdr,
    frame_fault,
)

IMU_TYPE = "sensor_msgs/msg/Imu"
RATES_TOPIC = "/imu/data"
ACTUATORS_TOPIC = "/actuators"
AIRSPEED_TOPIC = "/airspeed"

TOPIC_OPTIONS = {
    "imu.type": "--imu-topic",
    "actuators.type": "--actuators-topic",
    "airspeed.type": "--airspeed-topic",
}
"""Options of `replay` that name the topic whose type a setting gives."""

# Why the shells refuse a message before the identifier sees it.
WRONG_FRAME, NO_RATES = "wrong frame", "no rates"
NOT_FINITE, WRONG_CHANNELS = "not finite", "wrong channels"


@dataclass(frozen=True)
class Inputs:
    """Which topics of a bag to read, and the settings that fit their types.

    Parameters
    ----------
    rates_topic, actuators_topic : str
        Topics of the bag.
    settings : Settings
        Settings whose message types are those of the topics.
    airspeed_topic : str
        Topic of the airspeed; empty if there is none in the settings.
    """

    rates_topic: str
    actuators_topic: str
    settings: Settings
    airspeed_topic: str = ""

    @property
    def topics(self) -> tuple[str, ...]:
        """Every topic that is read."""
        topics = (self.rates_topic, self.actuators_topic, self.airspeed_topic)
        return tuple(topic for topic in topics if topic)


def choose_inputs(
    bag: Bag,
    parameters: Mapping[str, object],
    rates_topic: str | None = None,
    actuators_topic: str | None = None,
    airspeed_topic: str | None = None,
) -> Inputs:
    """Find the input topics of a bag.

    Parameters
    ----------
    bag : Bag
        The bag.
    parameters : mapping
        Parameters by dotted name; a message type that is not among them is the topic's.
    rates_topic, actuators_topic : str, optional
        Topics to take. Left out: ``/imu/data`` and ``/actuators`` if the bag has them, else
        the only topic of a known type.
    airspeed_topic : str, optional
        Topic to take. Left out: none, or, if ``airspeed.type`` is set, ``/airspeed`` or else the
        only topic of that type.

    Raises
    ------
    BagError
        If a topic is missing, not of a usable type, or there are several to choose from.
    SettingsError
        If a parameter is wrong.
    """
    values = dict(parameters)
    Settings.from_values(values)  # what is wrong with the parameters comes before the bag
    wanted = [
        ("imu.type", rates_topic, RATES_TOPIC, RATE_TYPES),
        ("actuators.type", actuators_topic, ACTUATORS_TOPIC, ACTUATOR_TYPES),
    ]
    if airspeed_topic or values.get("airspeed.type"):
        wanted.append(("airspeed.type", airspeed_topic, AIRSPEED_TOPIC, AIRSPEED_TYPES))
    topics = {}
    for setting, asked, default, known in wanted:
        topics[setting] = _choose(bag, values.get(setting), setting, asked, default, known)
        values[setting] = bag.type_of(topics[setting])
    return Inputs(
        topics["imu.type"],
        topics["actuators.type"],
        Settings.from_values(values),
        topics.get("airspeed.type", ""),
    )


def _choose(
    bag: Bag,
    wanted: object,
    setting: str,
    asked: str | None,
    default: str,
    known: tuple[str, ...],
) -> str:
    """Return the topic asked for, or else the one to be found, if its type will do."""
    types = (str(wanted),) if wanted else known
    topic = asked or _find_topic(bag, default, types, setting)
    msgtype = bag.type_of(topic)
    if msgtype not in types:
        reason = f"'{setting}' is '{wanted}'" if wanted else f"known are {', '.join(known)}"
        raise BagError(f"bag '{bag.path}': topic '{topic}' is of type {msgtype}, but {reason}")
    return topic


def _find_topic(bag: Bag, default: str, types: tuple[str, ...], setting: str) -> str:
    """Return the default topic, or the only one of the given types."""
    if default in bag.types:
        return default
    candidates = [topic for topic, msgtype in bag.types.items() if msgtype in types]
    if not candidates:
        raise BagError(
            f"bag '{bag.path}' has neither a topic '{default}' nor one of type "
            f"{' or '.join(types)}; it has {bag.contents()}"
        )
    if len(candidates) > 1:
        raise BagError(
            f"bag '{bag.path}' has no topic '{default}', but {', '.join(candidates)}: choose one "
            f"with {TOPIC_OPTIONS[setting]}"
        )
    return candidates[0]


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

    def of_era(self, era: int) -> tuple[TimeArray, FloatArray]:
        """Return stamps (k,), strictly rising, and values (k, width) of one time base."""
        chosen = np.array(self._era) == era
        values = np.array(self._values).reshape(-1, self._width)[chosen]
        t_ns, first = np.unique(np.array(self._t, dtype=np.int64)[chosen], return_index=True)
        return t_ns, values[first]


@dataclass(frozen=True)
class Refusals:
    """Messages of one stream and what became of them.

    Parameters
    ----------
    received : int
        Messages read.
    dropped : dict
        How many of them were not used, for each reason.
    """

    received: int
    dropped: dict[str, int]


@dataclass(frozen=True)
class Stretch:
    """What was measured and published on one time base, with one delay of the inputs.

    Parameters
    ----------
    era : int
        Restarts of the time base before it.
    t_ns : (N,) int array
        Stamps of all rates on the time base, ns.
    rates : (N, 3) array
        p, q, r, rad/s, FRD.
    force : (N, 2) array
        ay, az, m/s^2, FRD.
    inputs : InputSignal
        Inputs on the time base, with the delay.
    ticks : list of Estimate
        The estimates made with that delay.
    """

    era: int
    t_ns: TimeArray
    rates: FloatArray
    force: FloatArray
    inputs: InputSignal
    ticks: list[Estimate]


class OfflineRun:
    """One pass of the identifier over the messages of a bag.

    Parameters
    ----------
    inputs : Inputs
        Topics and settings.
    initial : CoefficientSet, optional
        Coefficients to start from.

    Attributes
    ----------
    estimates : list of Estimate
        One per tick, in order.
    frame_id : str
        Frame of the rates.
    frame_ids : set of str
        Every frame that the rates have come in.
    fault : str
        How the messages contradict the settings; empty if they do not.
    """

    def __init__(self, inputs: Inputs, initial: CoefficientSet | None = None) -> None:
        self.inputs = inputs
        self.identifier = OnlineIdentifier(inputs.settings, initial)
        self.estimates: list[Estimate] = []
        self.frame_id: str | None = None
        self.frame_ids: set[str] = set()
        self._frame_fault = ""
        self._read_channels = ActuatorReader(inputs.settings.actuators)
        self._rates = Record(6)
        self._actuators = Record(len(inputs.settings.actuators.channels))
        self._received: Counter[str] = Counter()
        self._refused: dict[str, Counter[str]] = {
            stream: Counter() for stream in self.identifier.drops
        }
        self._era = 0
        self._contexts: list[tuple[int, float]] = []  # time base and delay of each estimate
        self._newest_ns: int | None = None
        self._jump_ns = round(inputs.settings.time_jump * 1e9)

    @property
    def structure(self) -> Structure:
        """Structure of the estimates."""
        return self.identifier.structure

    @property
    def fault(self) -> str:
        """How the messages contradict the settings; empty if they do not."""
        return self._frame_fault or self.identifier.fault

    # -- messages in -----------------------------------------------------------------------

    def run(self, bag: Bag, wrap: Callable[[Iterable[Message], int], Iterable[Message]]) -> None:
        """Feed every message of the topics, in log-time order.

        Parameters
        ----------
        bag : Bag
            The bag.
        wrap : callable
            Wraps the messages and their number, for a progress bar.

        Raises
        ------
        BagError
            If the bag turns out to be damaged.
        """
        inputs, identifier = self.inputs, self.identifier
        take_rates = self._rates_taker(bag)
        decode = {topic: bag.decoder(topic) for topic in inputs.topics}
        total = sum(bag.counts[topic] for topic in inputs.topics)
        for topic, log_ns, data in wrap(bag.messages(inputs.topics), total):
            if topic == inputs.rates_topic:
                take_rates(data)
            elif topic == inputs.actuators_topic:
                self._take_actuators(decode[topic](data), log_ns)
            else:
                self._take_airspeed(decode[topic](data), log_ns)
            while (t_ns := identifier.due()) is not None:
                estimate = identifier.update(t_ns)
                if estimate is not None:
                    self.estimates.append(estimate)
                    self._contexts.append((self._era, identifier.delay))

    def _rates_taker(self, bag: Bag) -> Callable[[bytes], None]:
        """Return what takes the bytes of a message on the rates topic."""
        decode = bag.decoder(self.inputs.rates_topic)
        msgtype = self.inputs.settings.imu.type
        read = RATES[msgtype].read
        if msgtype != IMU_TYPE:
            return lambda data: self._take_rates(read(decode(data)))
        return lambda data: self._take_rates(decode_imu_cdr(data) or read(decode(data)))

    def _take_rates(self, reading: RatesReading) -> None:
        self._received["rates"] += 1
        t_ns, rates, force, frame_id = reading
        if frame_id != self.frame_id:
            self.frame_id = frame_id
            self.frame_ids.add(frame_id)
            imu = self.inputs.settings.imu
            self._frame_fault = frame_fault(imu.convention, frame_id, imu.type)
        if self._frame_fault:
            self._refused["rates"][WRONG_FRAME] += 1
        elif rates is None:
            self._refused["rates"][NO_RATES] += 1
        elif self.identifier.add_rates(t_ns, rates, force) is None:
            if self._newest_ns is not None and abs(t_ns - self._newest_ns) > self._jump_ns:
                self._era += 1
                self._newest_ns = t_ns
            self._newest_ns = max(t_ns, self._newest_ns or t_ns)
            self._rates.append(t_ns, (*rates, *(force or _NO_FORCE)), self._era)

    def _take_actuators(self, message: object, log_ns: int) -> None:
        self._received["actuators"] += 1
        try:
            stamp_ns, values = self._read_channels(message)
        except ChannelError as error:
            reason = NOT_FINITE if error.not_finite else WRONG_CHANNELS
            self._refused["actuators"][reason] += 1
            return
        t_ns = log_ns if stamp_ns is None else stamp_ns
        if self.identifier.add_actuators(t_ns, values) is None:
            self._actuators.append(t_ns, values, self._era)

    def _take_airspeed(self, message: object, log_ns: int) -> None:
        self._received["airspeed"] += 1
        stamp_ns, airspeed = AIRSPEED[self.inputs.settings.airspeed.type](message)
        self.identifier.add_airspeed(log_ns if stamp_ns is None else stamp_ns, airspeed)

    def refusals(self, stream: str) -> Refusals:
        """Count what became of the messages of ``rates``, ``actuators`` or ``airspeed``."""
        dropped = Counter(self._refused[stream])
        for drop, count in self.identifier.drops[stream].items():
            dropped[drop.value] += count
        kept = {reason: count for reason, count in sorted(dropped.items()) if count > 0}
        return Refusals(self._received[stream], kept)

    # -- results ---------------------------------------------------------------------------

    def result(self) -> CoefficientSet:
        """Return the coefficients at the last tick; with an airspeed, at its reference."""
        return self.identifier.coefficient_set(self.estimates[-1].t_ns)

    def measured(self, era: int = 0) -> tuple[TimeArray, FloatArray, FloatArray]:
        """Return the rates of one time base: stamps (k,), p q r (k, 3), ay az (k, 2), FRD."""
        t_ns, values = self._rates.of_era(era)
        frame = BodyFrame(self.inputs.settings.imu)
        return t_ns, frame.to_body(values[:, :3]), frame.to_body(values[:, 3:])[:, 1:]

    def input_signal(self, era: int = 0, delay: float | None = None) -> InputSignal:
        """Return the inputs on one time base, with the delay (s; None: the setting) and lag."""
        t_ns, raw = self._actuators.of_era(era)
        actuators = self.inputs.settings.actuators
        delay = actuators.delay if delay is None else delay
        # The identifier's own map: it may have learned the trim in flight.
        u = self.identifier.input_map.apply(raw)
        return InputSignal(t_ns, u, delay, actuators.time_constant)

    def score(self) -> dict[str, PredictionFit]:
        """Return the score of record of the estimates."""
        parts = list(self._window_errors())
        first_ns = min(int(t[0]) for t, _ in parts)
        last_ns = max(int(t[-1]) for t, _ in parts)
        return score_windows(WindowErrors.join([e for _, e in parts]), first_ns, last_ns)

    def stretches(self) -> Iterator[Stretch]:
        """Yield what was measured and published on every time base, and with every delay."""
        for context in sorted(set(self._contexts)):
            era, delay = context
            t_ns, rates, force = self.measured(era)
            pairs = zip(self.estimates, self._contexts, strict=True)
            ticks = [estimate for estimate, other in pairs if other == context]
            yield Stretch(era, t_ns, rates, force, self.input_signal(era, delay), ticks)

    def blocks(self, part: Stretch) -> Iterator[Block]:
        """Yield the signals of a stretch on a uniform grid, a block for each part without gaps.

        They are conditioned as in flight, with the trim and the delay of the stretch; the inputs
        without the delay are there too.
        """
        settings = self.inputs.settings
        actuators = replace(settings.actuators, estimate_delay=True, learn_trim_time=0.0)
        sampler = Sampler(replace(settings, actuators=actuators))
        sampler.delay = part.inputs.delay
        sampler.input_map = self.identifier.input_map
        sampler.rates.t, sampler.rates.v = self._rates.of_era(part.era)
        sampler.raw_inputs.t, sampler.raw_inputs.v = self._actuators.of_era(part.era)
        yield from sampler.blocks()

    def _window_errors(self) -> Iterator[tuple[TimeArray, WindowErrors]]:
        """Stamps and windows of every stretch of the flight."""
        for part in self.stretches():
            yield (
                part.t_ns,
                window_errors(
                    part.t_ns,
                    part.rates,
                    part.inputs,
                    part.force,
                    np.array([estimate.t_ns for estimate in part.ticks], dtype=np.int64),
                    np.array([estimate.coefficients for estimate in part.ticks]),
                    self.structure,
                    lever_arm=np.array(self.inputs.settings.imu.lever_arm),
                ),
            )


_NO_FORCE = (0.0, 0.0, 0.0)
