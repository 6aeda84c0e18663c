# SPDX-License-Identifier: Apache-2.0
"""The pipeline on a bag: the estimates that the node would have published, and their score.

It has no estimation logic: it passes messages in by log time, as the node does in flight, and
requests due ticks.
"""

from __future__ import annotations

import sys
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from uav_ident_ros.bags.reading import Bag, BagError, Message
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.frames import BodyFrame
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.prediction import (
    HORIZONS,
    Flown,
    InputSignal,
    PredictionFit,
    Published,
    WindowErrors,
    score_windows,
    window_errors,
)
from uav_ident_ros.identification.samples import ACTUATORS, NS_PER_S, RATES_STREAM, TimeArray
from uav_ident_ros.identification.sampling import Block, Sampler
from uav_ident_ros.identification.scales import LOOK_TIME
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.identification.supervision import State
from uav_ident_ros.messages.feed import Feed
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.messages.types import NOT_DECODABLE, ChannelError
from uav_ident_ros.offline.inputs import BagInputs, choose_inputs
from uav_ident_ros.offline.ticks import Ticks

PORTION = 8192
"""Imu samples conditioned at a time: a minute or less, which takes some MB."""

PIECE = 4096
"""Ticks predicted at a time, hence models that run in parallel."""


PAUSE_NS = NS_PER_S
"""Time between two time bases on the clock of the flight, ns: the true time is unknown, or days. No
window of the score spans it."""


LINE_EVERY = 30.0
"""Interval of lines of progress without a terminal, s."""


class Bar(tqdm):
    """A progress bar on the error stream; without a terminal, a line every `LINE_EVERY`."""

    monitor_interval = 0  # its thread would receive Ctrl-C while this one blocks it

    def __init__(self, *what: Any, **options: Any) -> None:
        pace = {} if sys.stderr.isatty() else {"mininterval": LINE_EVERY, "delay": LINE_EVERY}
        super().__init__(*what, leave=False, miniters=0, **pace, **options)


@dataclass(frozen=True)
class Refusals:
    """Counts of received and dropped messages of one stream."""

    received: int  # Messages read
    dropped: dict[str, int]  # Messages dropped, for each reason

    @property
    def text(self) -> str:
        """Counts of dropped messages with their reasons."""
        return ", ".join(f"{count} {reason}" for reason, count in self.dropped.items())


class Record:
    """Samples of one stream that the identifier accepted, by the clock of the flight."""

    def __init__(
        self,
        width: int,  # Values per sample
    ) -> None:
        self._width = width
        self._t, self._values = array("q"), array("d")

    def append(self, t_ns: int, values: Iterable[float]) -> None:
        """Add a sample."""
        self._t.append(t_ns)
        self._values.extend(values)

    def samples(self) -> tuple[TimeArray, FloatArray]:
        """Return stamps (k,), strictly rising, and values (k, width).

        They may be views of the record: while they exist, no sample can be added.
        """
        t_ns = np.frombuffer(self._t, np.int64)
        values = np.frombuffer(self._values).reshape(-1, self._width)
        if (t_ns[1:] > t_ns[:-1]).all():
            return t_ns, values
        t_ns, first = np.unique(t_ns, return_index=True)
        return t_ns, values[first]


class OfflineRun:
    """One pass of the identifier over the messages of a bag.

    The clock of the flight goes on where that of the stamps jumps: each time base begins `PAUSE_NS`
    after the last.
    """

    def __init__(
        self,
        inputs: BagInputs,  # Topics and settings
        initial: CoefficientSet | None = None,  # Initial coefficients
        **parts: Any,  # User-defined parts: `estimator`, `gates` of `OnlineIdentifier`
    ) -> None:
        self.inputs = inputs
        self.identifier = OnlineIdentifier(inputs.settings, initial, **parts)
        self.structure: Structure = self.identifier.structure  # Structure of the estimates
        self.estimates = Ticks(self.structure)  # One per tick, in order
        self.tick_ns: list[int] = []  # Their times by the clock of the flight, ns
        self.restarts: list[int] = []  # Starts of the later time bases by that clock, ns
        self.frame_ids: set[str] = set()  # All frames of the rates
        # Accepted samples: rates and forces in the sensor's axes, actuators as raw channels
        self._rates, self._actuators = Record(6), Record(len(inputs.settings.actuators.channels))
        self._feeds: dict[str, Feed] = {}
        self._newest_ns: int | None = None
        self._shift_ns = 0  # From the stamps to the clock of the flight, ns
        self._learned = -1  # Index of the last tick that learned; the last tick if none did
        # Indices of the estimates with each delay and lag
        self._ticks_of: dict[tuple[float, float], list[int]] = defaultdict(list)

    def run(
        self,
        bag: Bag,
        shown: bool = False,  # Whether to show a progress bar
    ) -> None:
        """Run the identifier on all messages of the topics, in the order of log time.

        Raises `BagError` if a topic is missing, its type is unknown, or nothing can be read.
        """
        topics = self.inputs.topics
        for stream in STREAMS:
            if topic := self.inputs.streams.get(stream.name):
                self._feeds[stream.name] = Feed(stream, self.identifier, _decoder(bag, topic))
        feeds = {topic: self._feeds[name] for name, topic in self.inputs.streams.items()}
        total, messages = sum(bag.counts[topic] for topic in topics), bag.messages(topics)
        for message in Bar(messages, total=total, unit=" messages", disable=not shown):
            self._take(feeds[message.topic], message)
            self._tick()

    def _take(self, feed: Feed, message: Message) -> None:
        taken = feed.take(message.data, message.log_ns)
        if feed.stream.name == RATES_STREAM:
            if self.frame_id is not None:
                self.frame_ids.add(self.frame_id)
            if taken is not None:
                self._keep_rates(*taken)
        elif feed.stream.name == ACTUATORS and taken is not None:
            t_ns, values = taken
            t_ns -= self.identifier.intake.clock_steps.correction_ns
            self._actuators.append(t_ns + self._shift_ns, values)

    def _keep_rates(self, t_ns: int, values: Any) -> None:
        jump_ns = round(self.inputs.settings.time_jump * NS_PER_S)
        if self._newest_ns is not None and abs(t_ns - self._newest_ns) > jump_ns:
            self._shift_ns += self._newest_ns + PAUSE_NS - t_ns
            self.restarts.append(t_ns + self._shift_ns)
            self._newest_ns = t_ns
        self._newest_ns = max(t_ns, self._newest_ns or t_ns)
        rates, force = values
        self._rates.append(t_ns + self._shift_ns, (*rates, *(force or (0.0, 0.0, 0.0))))
        for feed in self._feeds.values():
            feed.settle()

    def _tick(self) -> None:
        identifier = self.identifier
        for estimate in identifier.advance():
            index = len(self.estimates)
            if identifier.idle == 0.0 and identifier.speed_believed:
                self._learned = index
            self._ticks_of[identifier.delay, identifier.lag].append(index)
            self.estimates.append(estimate)
            self.tick_ns.append(estimate.t_ns + self._shift_ns)

    # -- results ---------------------------------------------------------------------------

    @property
    def frame_id(self) -> str | None:
        """Newest frame of the rates."""
        frame_id: str | None = self._feeds[RATES_STREAM].reader.frame_id
        return frame_id

    @property
    def fault(self) -> str:
        """Contradiction of the messages to the settings; empty if there is none."""
        rates = self._feeds[RATES_STREAM]
        return (str(rates.reader.fault) if rates.received else "") or self.identifier.intake.fault

    def refusals(self, stream: str) -> Refusals:
        """Return the counts of received and dropped messages of a stream that is read."""
        feed = self._feeds[stream]
        return Refusals(feed.received, dict(sorted(feed.drops().items())))

    def problems(self, stream: str) -> str:
        """Return the problem of the last unused message of a stream for each reason."""
        return "; ".join(self._feeds[stream].details.values())

    @property
    def judged(self) -> Estimate:
        """The estimate whose verdict is that of the flight.

        It is that of the last tick. If nothing was learned lately (the aircraft has landed, or the
        inputs have ended), the verdict has expired; then it is that of the last tick that learned.
        A fault at the end counts.
        """
        last, identifier = self.estimates[-1], self.identifier
        doubted = last.state == State.FAULT.value or identifier.plausibility.doubt is not None
        if doubted or identifier.idle <= LOOK_TIME:
            return last
        return self.estimates[self._learned]

    def result(self) -> CoefficientSet:
        """Return the coefficients at the last tick, at the reference airspeed if there is one."""
        return self.identifier.coefficient_set(self.estimates[-1].t_ns)

    def score(self) -> dict[str, PredictionFit]:
        """Return the score of record of the estimates, as if no time had passed in the pauses."""
        errors = WindowErrors.join([window_errors(*piece) for piece in self.pieces(HORIZONS[-1])])
        pauses = np.searchsorted(self.restarts, errors.t_ns, side="right")
        errors = replace(errors, t_ns=errors.t_ns - PAUSE_NS * pauses)
        t_ns, _ = self._rates.samples()
        return score_windows(errors, int(t_ns[0]), int(t_ns[-1]) - PAUSE_NS * len(self.restarts))

    def flown(self) -> Flown:
        """Return the measurements, by the clock of the flight; the inputs act as at most ticks."""
        imu = self.inputs.settings.imu
        arm, frame = np.array(imu.lever_arm), BodyFrame(imu)
        t_ns, values = self._rates.samples()
        rates, force = frame.to_body(values[:, :3]), frame.to_body(values[:, 3:])[:, 1:].copy()
        raw_t_ns, raw = self._actuators.samples()
        # The identifier's own map has the trim that it may have learned in flight.
        u = self.identifier.sampler.input_map.apply(raw)
        delay, lag = max(self._ticks_of, key=lambda acting: len(self._ticks_of[acting]))
        return Flown(t_ns, rates, InputSignal(raw_t_ns, u, delay, lag), force, arm)

    def pieces(self, horizon: float) -> Iterator[tuple[Flown, Published]]:
        """Yield groups of ticks with the measurements for predictions `horizon` s ahead.

        The inputs of a group have one delay. Its grid takes some MB; that of an hour would take
        hundreds.
        """
        flown, tick_ns, ahead_ns = self.flown(), np.array(self.tick_ns), round(horizon * NS_PER_S)
        for (delay, lag), ticks in sorted(self._ticks_of.items()):
            inputs = replace(flown.inputs, delay=delay, time_constant=lag)
            for first in range(0, len(ticks), PIECE):
                which = ticks[first : first + PIECE]
                stamps = tick_ns[which]
                begin = np.searchsorted(flown.t_ns, stamps[0], side="right") - 1
                end = np.searchsorted(flown.t_ns, stamps[-1] + ahead_ns) + 1
                near = slice(max(int(begin), 0), int(end))
                parts = {name: getattr(flown, name)[near] for name in ("t_ns", "rates", "force")}
                published = Published.of(self.estimates.chosen(which), self.structure)
                yield replace(flown, inputs=inputs, **parts), replace(published, t_ns=stamps)

    def blocks(self, inputs: InputSignal) -> Iterator[Block]:
        """Yield the signals on a uniform grid, in blocks of at most `PORTION`.

        They are conditioned as in flight, with the trim, and delay and lag of `inputs`.
        """
        settings = self.inputs.settings
        actuators = replace(settings.actuators, learn_trim_time=0.0)
        sampler = Sampler(replace(settings, actuators=actuators))
        sampler.delay, sampler.time_constant = inputs.delay, inputs.time_constant
        sampler.input_map = self.identifier.sampler.input_map
        sampler.raw_inputs.t, sampler.raw_inputs.v = self._actuators.samples()
        t_ns, values = self._rates.samples()
        for first in range(0, len(t_ns), PORTION):
            new = slice(first, first + PORTION)
            sampler.rates.t = np.concatenate([sampler.rates.t, t_ns[new]])
            sampler.rates.v = np.concatenate([sampler.rates.v, values[new]])
            yield from sampler.blocks()


def _decoder(bag: Bag, topic: str) -> Callable[[bytes], object]:
    """Return the decoder of a topic, by the definitions in the bag."""
    decode = bag.decoder(topic)

    def decoded(data: bytes) -> object:
        try:
            return decode(data)
        except BagError as error:
            raise ChannelError(str(error), NOT_DECODABLE) from None

    return decoded


def run_over(
    path: Path,  # The bag
    values: Mapping[str, Any],  # Parameters by name
    initial: CoefficientSet | None = None,  # Initial coefficients
    **parts: Any,  # User-defined parts, as in `OfflineRun`
) -> OfflineRun:
    """Return the finished run of the identifier on a bag."""
    with Bag(path) as bag:
        run = OfflineRun(choose_inputs(bag, values), initial, **parts)
        run.run(bag)
    return run
