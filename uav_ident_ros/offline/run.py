# SPDX-License-Identifier: Apache-2.0
"""The pipeline over a bag: what the node would have published in flight, and how good it was.

There is no estimation logic here: messages go in by log time, due ticks are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.bags.reading import Bag, Message
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
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.sampling import Block, Sampler
from uav_ident_ros.identification.scales import LOOK_TIME
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.identification.supervision import State
from uav_ident_ros.offline.inputs import Inputs, Intake, Refusals, choose_inputs
from uav_ident_ros.offline.ticks import Ticks

BLOCK = 8192
"""Samples of an Imu that are conditioned at a time: a minute or less, which takes some MB."""

PIECE = 4096
"""Ticks that are predicted at a time: as many as the models that run side by side."""


@dataclass(frozen=True)
class Stretch(Flown):
    """What was measured and published on one time base, with one delay of the inputs."""

    force: FloatArray
    _: KW_ONLY
    era: int  # Restarts of the time base before it
    ticks: Ticks  # The estimates made with that delay

    def pieces(self, horizon: float) -> Iterator[Stretch]:
        """Yield it in parts of some ticks, with what is needed to predict them `horizon` s ahead.

        On a grid of its own each piece takes some MB; that of an hour would take hundreds.
        """
        ahead_ns = round(horizon * 1e9)
        for first in range(0, len(self.ticks), PIECE):
            ticks = self.ticks[first : first + PIECE]
            stamps = ticks.stamps()
            begin = np.searchsorted(self.t_ns, stamps[0], side="right") - 1
            end = np.searchsorted(self.t_ns, stamps[-1] + ahead_ns) + 1
            measured = slice(max(int(begin), 0), int(end))
            parts = {name: getattr(self, name)[measured] for name in ("t_ns", "rates", "force")}
            yield replace(self, **parts, ticks=ticks)


Wrap = Callable[[Iterable[Message], int], Iterable[Message]]
"""Wraps the messages and their number, for a progress bar."""


class OfflineRun:
    """One pass of the identifier over the messages of a bag."""

    def __init__(
        self,
        inputs: Inputs,  # Topics and settings
        initial: CoefficientSet | None = None,  # Coefficients to start from
        **parts: Any,  # Parts of one's own: `estimator`, `gates` of `OnlineIdentifier`
    ) -> None:
        self.inputs = inputs
        self.identifier = OnlineIdentifier(inputs.settings, initial, **parts)
        self.intake = Intake(inputs, self.identifier)  # What became of the messages
        self.estimates = Ticks(self.identifier.structure)  # One per tick, in order
        self._learned = -1  # Place of the last one that learned; the last of all if none did
        # time base, delay and lag of each estimate
        self._contexts: list[tuple[int, float, float]] = []

    @property
    def structure(self) -> Structure:
        """Structure of the estimates."""
        return self.identifier.structure

    @property
    def fault(self) -> str:
        """How the messages contradict the settings; empty if they do not."""
        return self.intake.fault or self.identifier.intake.fault

    def refusals(self, stream: str) -> Refusals:
        """Count what became of the messages of a stream, ``rates`` or ``actuators`` for two."""
        return self.intake.refusals(stream)

    def run(self, bag: Bag, wrap: Wrap) -> None:
        """Feed every message of the topics, in log-time order.

        Raises
        ------
        BagError
            If nothing can be read.
        """
        self.intake.read_with(bag)
        topics = self.inputs.topics
        for message in wrap(bag.messages(topics), sum(bag.counts[topic] for topic in topics)):
            self.intake.take(message)
            self._tick()

    def _tick(self) -> None:
        identifier = self.identifier
        for estimate in identifier.advance():
            if identifier.idle == 0.0:
                self._learned = len(self.estimates)
            self.estimates.append(estimate)
            context = (self.intake.era, identifier.delay, identifier.lag)
            last = self._contexts[-1] if self._contexts else None
            self._contexts.append(last if last == context else context)

    # -- results ---------------------------------------------------------------------------

    @property
    def judged(self) -> Estimate:
        """The estimate whose verdict is that of the flight.

        That of the last tick; of the last that learned where the aircraft has landed since, or the
        inputs ended, and the verdict ages, as a controller must see it: what the flight has shown
        stays. A fault at the end counts.
        """
        last, identifier = self.estimates[-1], self.identifier
        doubted = last.state == State.FAULT.value or identifier.plausibility.doubted
        if doubted or identifier.idle <= LOOK_TIME:
            return last
        return self.estimates[self._learned]

    def result(self) -> CoefficientSet:
        """Return the coefficients at the last tick; with an airspeed, at its reference."""
        return self.identifier.coefficient_set(self.estimates[-1].t_ns)

    def measured(self, era: int = 0) -> tuple[TimeArray, FloatArray, FloatArray]:
        """Return the rates of one time base: stamps (k,), p q r (k, 3), ay az (k, 2), FRD."""
        t_ns, values = self.intake.rates.of_era(era)
        frame = BodyFrame(self.inputs.settings.imu)
        return t_ns, frame.to_body(values[:, :3]), frame.to_body(values[:, 3:])[:, 1:].copy()

    def input_signal(
        self, era: int = 0, delay: float | None = None, lag: float | None = None
    ) -> InputSignal:
        """Return the inputs on one time base, with delay and lag (s; None: the settings)."""
        t_ns, raw = self.intake.actuators.of_era(era)
        actuators = self.inputs.settings.actuators
        delay = actuators.delay if delay is None else delay
        lag = actuators.time_constant if lag is None else lag
        # The identifier's own map: it may have learned the trim in flight.
        u = self.identifier.sampler.input_map.apply(raw)
        return InputSignal(t_ns, u, delay, lag)

    def score(self) -> dict[str, PredictionFit]:
        """Return the score of record of the estimates."""
        errors, ends = [], []
        for part in self.stretches():
            ends += [int(part.t_ns[0]), int(part.t_ns[-1])]
            for piece in part.pieces(HORIZONS[-1]):
                errors.append(window_errors(piece, Published.of(piece.ticks, self.structure)))
        return score_windows(WindowErrors.join(errors), min(ends), max(ends))

    def eras(self) -> TimeArray:
        """Return the restarts of the time base before each estimate, shape (K,)."""
        return np.array([era for era, *_ in self._contexts], dtype=np.int64)

    def stretches(self) -> Iterator[Stretch]:
        """Yield what was measured and published on every time base, and with every delay."""
        arm = np.array(self.inputs.settings.imu.lever_arm)
        contexts = sorted(set(self._contexts))
        measured = {era: self.measured(era) for era in {era for era, *_ in contexts}}
        for context in contexts:
            era, delay, lag = context
            t_ns, rates, force = measured[era]
            which = np.flatnonzero([other == context for other in self._contexts])
            yield Stretch(
                t_ns, rates, self.input_signal(era, delay, lag), force, arm,
                era=era, ticks=self.estimates.chosen(which),
            )  # fmt: skip

    def blocks(self, part: Stretch) -> Iterator[Block]:
        """Yield the signals of a stretch on a uniform grid, in blocks of `BLOCK` samples at most.

        They are conditioned as in flight, with the trim and the delay of the stretch.
        """
        settings = self.inputs.settings
        actuators = replace(settings.actuators, learn_trim_time=0.0)
        sampler = Sampler(replace(settings, actuators=actuators))
        sampler.delay, sampler.time_constant = part.inputs.delay, part.inputs.time_constant
        sampler.input_map = self.identifier.sampler.input_map
        sampler.raw_inputs.t, sampler.raw_inputs.v = self.intake.actuators.of_era(part.era)
        t_ns, values = self.intake.rates.of_era(part.era)
        for first in range(0, len(t_ns), BLOCK):
            new = slice(first, first + BLOCK)
            sampler.rates.t = np.concatenate([sampler.rates.t, t_ns[new]])
            sampler.rates.v = np.concatenate([sampler.rates.v, values[new]])
            yield from sampler.blocks()


def run_over(
    path: Path,  # The bag
    values: Mapping[str, Any],  # Parameters by name
    initial: CoefficientSet | None = None,  # Coefficients to start from
    wrap: Wrap = lambda messages, _: messages,  # As in `OfflineRun.run`
    **parts: Any,  # Parts of one's own, as in `OfflineRun`
) -> OfflineRun:
    """Return the finished run of the identifier over a bag."""
    with Bag(path) as bag:
        run = OfflineRun(choose_inputs(bag, values), initial, **parts)
        run.run(bag, wrap)
    return run
