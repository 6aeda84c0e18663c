# SPDX-License-Identifier: Apache-2.0
"""Rates and inputs on one uniform grid at the gyro's rate.

Every gyro sample counts: the grid has the gyro's own rate and phase, and between samples the
rates are straight lines. The inputs are shifted by delay and lag and averaged over the cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.frames import BodyFrame, centripetal
from uav_ident_ros.identification.inputs import InputMap, ServoLag, cell_means
from uav_ident_ros.identification.samples import SampleBuffer, TimeArray
from uav_ident_ros.identification.settings import MAX_DELAY, Settings
from uav_ident_ros.identification.structure import BoolArray, FloatArray

RATE_SAMPLES = 20
"""Samples from which the Imu's rate is found: enough for a median that drop-outs don't move."""

FASTEST_CELL_NS = 1_000_000
"""Shortest cell, ns: 1 kHz, the highest Imu rate worth following."""

STEADY_RATE = 0.1
"""Mean and standard deviation of the rates below which flight is steady, rad/s."""


@dataclass(frozen=True)
class Block:
    """Signals over m consecutive cells of the grid, body axes FRD.

    Parameters
    ----------
    t_ns : (m + 1,) int array
        Edges of the cells, ns.
    h : float
        Cell width, s.
    x : (m + 1, 3) array
        Rates p, q, r at the edges, rad/s.
    u : (m, 4) array
        Means of de, dr, da, dth over the cells.
    force : (m + 1, 2) array
        Specific forces ay, az at the edges, m/s^2, less their centripetal part.
    restarted : bool
        Whether the first edge does not continue the block before.
    """

    t_ns: TimeArray
    h: float
    x: FloatArray
    u: FloatArray
    force: FloatArray
    restarted: bool


class Sampler:
    """Brings rates and inputs together on the grid.

    Parameters
    ----------
    settings : Settings
        Imu axes and lever arm, channel map, delay, lag, gap and timeout.
    """

    def __init__(self, settings: Settings) -> None:
        self._frame = BodyFrame(settings.imu)
        self._arm = np.array(settings.imu.lever_arm)
        self._actuators = settings.actuators
        self._max_gap_ns = round(settings.filter.max_gap * 1e9)
        self._timeout_ns = round(settings.actuators.timeout * 1e9)
        self.input_map = InputMap(settings.actuators)
        self._trim_known = settings.actuators.learn_trim_time == 0.0
        self.rates = SampleBuffer(6)
        self.raw_inputs = SampleBuffer(len(settings.actuators.channels))
        self.delay = settings.actuators.delay
        self._memory_ns = round(MAX_DELAY * 1e9)
        self.restart()

    def restart(self) -> None:
        """Drop all samples and find the Imu's rate anew; a learned trim stays."""
        self.rates.clear()
        self.raw_inputs.clear()
        self.h_ns: int | None = None
        self._lag: ServoLag | None = None
        self._edge_ns: int | None = None
        self._continues = False
        self.waiting_for = "rates"

    def held(self, t_ns: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Newest rates, inputs and specific forces at `t_ns`, as the paper samples them.

        Returns
        -------
        tuple of arrays or None
            x (3,), u (4,) and ay, az (2,); None while there are none or they are stale.
        """
        at = t_ns - round(self.delay * 1e9)
        last = int(np.searchsorted(self.raw_inputs.t, at, side="right")) - 1
        self.waiting_for = "rates" if not len(self.rates.t) else "actuators" if last < 0 else ""
        if self.waiting_for:
            return None
        rates_age = t_ns - int(self.rates.t[-1])
        if rates_age > self._max_gap_ns or at - int(self.raw_inputs.t[last]) > self._timeout_ns:
            self.waiting_for = "fresh samples"
            return None
        signals = self.rates.v[-1]
        u = self.input_map.apply(self.raw_inputs.v[last])
        self.rates.trim(t_ns)
        self.raw_inputs.trim(t_ns - self._memory_ns)
        x = self._frame.to_body(signals[:3])
        return x, u, self._frame.to_body(signals[3:])[1:] - centripetal(x, self._arm)

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks that the samples in use complete."""
        if not self._ready():
            return
        for first_ns, last_ns in self._runs():
            yield from self._cut(first_ns, last_ns)
        if self._edge_ns is not None:
            self.rates.trim(self._edge_ns)
            self.raw_inputs.trim(self._edge_ns - self._memory_ns)

    def _ready(self) -> bool:
        """Whether rate, inputs and trim are known; `waiting_for` says what is not."""
        if self.h_ns is None:
            if len(self.rates.t) <= RATE_SAMPLES:
                self.waiting_for = "rates"
                return False
            interval = int(np.median(np.diff(self.rates.t)))
            self.h_ns = max(interval, FASTEST_CELL_NS)
            self._lag = ServoLag(self._actuators.time_constant, self.h_ns * 1e-9)
        if not len(self.raw_inputs.t):
            self.waiting_for = "actuators"
            self.rates.trim(int(self.rates.t[-1]))
            return False
        if not self._trim_known and not self._learn_trim():
            self.waiting_for = "steady flight to learn the trim from"
            return False
        self.waiting_for = ""
        return True

    def _learn_trim(self) -> bool:
        """Take the mean raw channels over the first steady stretch of flight as trim."""
        span_ns = round(self._actuators.learn_trim_time * 1e9)
        newest = int(self.rates.t[-1])
        if newest - int(self.rates.t[0]) < span_ns:
            return False
        self.rates.trim(newest - span_ns)
        self.raw_inputs.trim(newest - span_ns)
        x = self.rates.v[:, :3]
        spread = np.maximum(np.abs(x.mean(axis=0)), x.std(axis=0))
        if spread.max() > STEADY_RATE:
            return False
        self.input_map.trim = self.raw_inputs.v.mean(axis=0)
        self._trim_known = True
        return True

    def _runs(self) -> Iterator[tuple[int, int]]:
        """Yield first and last stamp of the stretches of rates without a gap, in order."""
        t = self.rates.t
        breaks = np.flatnonzero(np.diff(t) > self._max_gap_ns)
        starts = [0, *(int(i) + 1 for i in breaks)]
        ends = [*(int(i) for i in breaks), len(t) - 1]
        for start, end in zip(starts, ends, strict=True):
            yield int(t[start]), int(t[end])

    def _cut(self, first_ns: int, last_ns: int) -> Iterator[Block]:
        """Yield the blocks within one gap-free stretch, cut where the inputs are unknown."""
        assert self.h_ns is not None
        start = self._edge_ns
        if start is None or start < first_ns:
            start, self._continues = first_ns, False
        edges = np.arange(start, last_ns + 1, self.h_ns, dtype=np.int64)
        if len(edges) < 2:
            return
        known = self._inputs_known(edges)
        for begin, end in _stretches(known):
            if end - begin > 1:
                yield self._block(edges[begin:end], begin > 0 or not self._continues)
                self._continues = True
        self._continues = bool(known[-2:].all())
        self._edge_ns = int(edges[-1])

    def _inputs_known(self, edges: TimeArray) -> BoolArray:
        at = edges - round(self.delay * 1e9)
        last = np.searchsorted(self.raw_inputs.t, at, side="right") - 1
        age = at - self.raw_inputs.t[np.maximum(last, 0)]
        return np.asarray((last >= 0) & (age <= self._timeout_ns))

    def _block(self, edges: TimeArray, restarted: bool) -> Block:
        assert self.h_ns is not None and self._lag is not None
        signals = self.rates.interpolate(edges)
        x = self._frame.to_body(signals[:, :3])
        force = self._frame.to_body(signals[:, 3:])[:, 1:]
        if self._arm.any():
            force = force - centripetal(x, self._arm)
        commanded = cell_means(
            self.raw_inputs.t,
            self.input_map.apply(self.raw_inputs.v),
            edges - round(self.delay * 1e9),
            self._actuators.interpolation,
        )
        if restarted:
            self._lag.restart(commanded[0])
        return Block(edges, self.h_ns * 1e-9, x, self._lag.apply(commanded), force, restarted)


def _stretches(flags: BoolArray) -> list[tuple[int, int]]:
    """Begin and end (exclusive) of each run of true flags."""
    if flags.all():
        return [(0, len(flags))]
    padded = np.concatenate([[0], flags.astype(np.int8), [0]])
    flips = [int(i) for i in np.flatnonzero(np.diff(padded))]
    return list(zip(flips[::2], flips[1::2], strict=True))
