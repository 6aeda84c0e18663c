# SPDX-License-Identifier: Apache-2.0
"""The identified model in parallel with the aircraft: instruments, and the running fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.flow import FlowObserver
from uav_ident_ros.identification.model import IdentifiedModel, bounded
from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.sampling import Block, edge_values, join
from uav_ident_ros.identification.scales import MEMORY, RESPONSE_TIME
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray, Structure


class ParallelModel:
    """The identified model, run on the same inputs as the aircraft.

    Its states contain neither gyro noise nor gusts, which makes them instruments. During injection
    its response to the injected signals only is free of feedback, too.
    """

    def __init__(self, settings: Settings, structure: Structure) -> None:
        arm = np.array(settings.imu.lever_arm)
        self.model = IdentifiedModel(structure, arm)
        self._response = IdentifiedModel(structure, arm)
        self._since_injected = RESPONSE_TIME
        self.flow: FlowObserver | None = None  # Without flow angles
        if structure.has_flow:
            self.flow = FlowObserver(structure, settings.filter.cutoff, settings.airspeed.reference)

    def follow(
        self,
        block: Block,  # Measured signals over m cells; its flow is set
        coefficients: FloatArray,  # (R, n) A_m at the airspeed flown
        airspeed: float | None,  # True, m/s; None without a measurement
        leak_time: float,  # Of the leak towards the measured state, s; 0 for none
    ) -> tuple[FloatArray, bool]:
        """Run the model over a block, and observe the flow in it.

        Returned are the state at the edges, (m + 1, 3 or 8), from which instruments follow, and
        whether it is the response to the injected signals only.
        """
        if self.flow is not None:
            block.flow = self.flow.follow(block, coefficients, airspeed)
        states = self.model.run(coefficients, block, leak_time)
        self._since_injected += block.time
        if block.excitation is None:
            return states, False
        if block.excitation.any():
            self._since_injected = 0.0
        if self._since_injected >= RESPONSE_TIME:
            return states, False
        return self._response.respond(coefficients, block, leak_time), True


# --- stretches ------------------------------------------------------------------------------------


class Stretch(NamedTuple):
    """Consecutive blocks, with the identifier's results on them."""

    block: Block  # Measured signals over m cells
    states: FloatArray  # (m + 1, 3 or 8) State of the identified model at the edges
    learns: bool  # Whether the gates are open
    readable: bool  # Whether it may be scored
    injected: bool  # Whether the states are the response to the injected signals only
    blocks: int = 1  # Number of blocks, one a tick

    @property
    def kind(self) -> tuple[bool, bool, bool]:
        """Flags that must agree for blocks to be joined."""
        return self.learns, self.readable, self.injected


class Stretches:
    """Join of blocks to stretches."""

    def __init__(self) -> None:
        self._parts: list[Stretch] = []

    def add(self, part: Stretch, length: float) -> Iterator[Stretch]:
        """Add a block; yield the stretches that end with it or before it, at `length` s."""
        if self._parts and (part.block.restarted or part.kind != self._parts[0].kind):
            yield self._ended()
        self._parts.append(part)
        if sum(p.block.time for p in self._parts) >= length - 0.5 * part.block.h:
            yield self._ended()

    def _ended(self) -> Stretch:
        """Join the parts so far."""
        parts, self._parts = self._parts, []
        if len(parts) == 1:
            return parts[0]
        block, states = join([p.block for p in parts]), edge_values([p.states for p in parts])
        return Stretch(block, states, *parts[0].kind, blocks=len(parts))


# --- running fit ----------------------------------------------------------------------------------


FAILED_PREDICTION = 4.0
"""Squared error of a failed prediction, relative to the signal's variation: that of the negative of
the measurement, a fit of -100 percent. A larger error counts as this one."""

# The sums over samples: count, x, x^2, then squared errors.
_SPREAD, _ERRORS, _MODEL, _HOLD, _SAVED = slice(0, 3), slice(3, 6), 3, 4, 5


class RunningFit:
    """Free 1-second prediction fit of the coefficients in use, of those saved, and of holding.

    Predictions follow one another. Each starts from the measured state, with the coefficients of
    that time, and runs on the measured inputs only. It is compared with every sample of its second.
    """

    def __init__(self, structure: Structure, model: IdentifiedModel) -> None:
        self._holds_force = structure.has_forces
        self._model = model
        # Fit of p, q, r in percent, of the coefficients in use, of the rates held, and of the saved
        # coefficients; 0 before the first prediction
        self.fit: FloatArray = np.zeros(3)
        self.hold: FloatArray = np.zeros(3)
        self.saved: FloatArray = np.zeros(3)
        self.predictions = 0  # Counted so far
        self._sums: FloatArray = np.zeros((6, 3))
        self.forget()

    def restart(self) -> None:
        """Drop the prediction under way."""
        self._parts: list[Block] = []
        self._time = 0.0

    def forget(self) -> None:
        """Clear the sums after a change of the aircraft; `fit` stays until the next prediction."""
        self.restart()
        self._age = 0.0
        self._sums.fill(0.0)

    def save(self) -> None:
        """Note that the coefficients in use are saved: up to now both have the same errors."""
        self._sums[_SAVED] = self._sums[_MODEL]

    def add(
        self,
        block: Block,
        coefficients: FloatArray,  # (R, n) In use at the start of the block
        saved: FloatArray | None,  # (R, n) Last saved
    ) -> None:
        """Add a block of signals; evaluate the prediction of each full second."""
        if block.restarted:
            self.restart()
        if not self._parts:
            self._coefficients, self._saved = coefficients, saved
        self._parts.append(block)
        self._time += block.time
        if self._time >= HORIZONS[0] - 0.5 * block.h:
            self._count(join(self._parts))
            self.restart()

    def _count(self, second: Block) -> None:
        """Predict a second, and add its errors."""
        if self._holds_force:
            held = np.broadcast_to(second.specific_force[:1], second.specific_force.shape)
            second = replace(second, specific_force=held)
        x, now = second.x[1:], np.zeros((6, 3))
        now[_SPREAD] = np.full(3, len(x)), x.sum(axis=0), (x * x).sum(axis=0)
        now[_HOLD] = ((x - second.x[0]) ** 2).sum(axis=0)
        now[_MODEL] = self._error(second, self._coefficients)
        if self._saved is not None:
            now[_SAVED] = self._error(second, self._saved)
        self.predictions += 1
        self._age += self._time
        sums = self._sums
        sums *= np.exp(-self._time / min(MEMORY, 0.5 * self._age))
        sums += now
        spread = _spread(sums)
        failed = FAILED_PREDICTION * np.maximum(_spread(now), spread * now[0] / sums[0])
        sums[_ERRORS] -= np.maximum(now[_ERRORS] - failed, 0.0)
        ratio = np.divide(sums[_ERRORS], spread, out=np.ones((3, 3)), where=spread > 0.0)
        self.fit, self.hold, self.saved = 100.0 * (1.0 - np.sqrt(ratio))
        if self._saved is None:
            self.saved = np.zeros(3)

    def _error(self, second: Block, coefficients: FloatArray) -> FloatArray:
        """Return the sum of the squared errors of a prediction, shape (3,)."""
        states = self._model.propagate(coefficients, second, second.state[0])
        return np.asarray(((second.x - bounded(states)[:, :3])[1:] ** 2).sum(axis=0))


def _spread(sums: FloatArray) -> FloatArray:
    """Return the sum of the squared deviations from the mean, shape (3,)."""
    count, total, square = sums[_SPREAD]
    return np.asarray(np.maximum(square - total * total / count, 0.0))
