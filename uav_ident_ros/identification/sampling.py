# SPDX-License-Identifier: Apache-2.0
"""Resampling of rates and inputs to one uniform grid at the gyro's rate.

Every gyro sample counts: the grid has the gyro's own rate and phase, and rates are interpolated
linearly. The inputs are delayed, lagged and averaged over the cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import TypeVar

import numpy as np

from uav_ident_ros.identification.filters import BlockFilter
from uav_ident_ros.identification.frames import BodyFrame, centripetal, lever_arm_matrix
from uav_ident_ros.identification.samples import NS, NS_PER_S, SampleBuffer, TimeArray
from uav_ident_ros.identification.scales import IN_A_ROW, SAMPLE_TIME
from uav_ident_ros.identification.settings import (
    EXCITATION_TIMEOUT,
    MAX_DELAY,
    ActuatorSettings,
    Settings,
)
from uav_ident_ros.identification.structure import INPUTS, FloatArray


class InputMap:
    """The map u = M (c(raw) - c(trim)), where c is the effect of a channel.

    For a surface ``c = raw``. A motor's thrust grows with the square of its speed: with the
    quadratic share f and s = scale raw from 0 to 1, ``scale c = f s^2 + (1 - f) s``. Its control
    derivative is then the same at any thrust.
    """

    def __init__(self, settings: ActuatorSettings) -> None:
        n = len(settings.channels)
        mixing = settings.mixing
        self._scale: FloatArray = np.array(settings.scale or (1.0,) * n)
        self._square: FloatArray = np.array(settings.thrust_curve or (0.0,) * n)
        self._bent = bool(self._square.any())
        rows = (mixing.de, mixing.dr, mixing.da, mixing.dth)
        self.matrix: FloatArray = np.array(rows) * self._scale
        self.trim: FloatArray = np.array(settings.trim or (0.0,) * n)

    def apply(self, raw: FloatArray) -> FloatArray:
        """Return inputs of shape (..., 4) from raw channels of shape (..., N)."""
        return self.mix(self.curved(raw))

    def curved(self, raw: FloatArray) -> FloatArray:
        """Return the effects c of raw channels of shape (..., N), in their own units."""
        if not self._bent:
            return raw
        return np.asarray(raw * (1.0 + self._square * (self._scale * raw - 1.0)))

    def mix(self, curved: FloatArray) -> FloatArray:
        """Return inputs of shape (..., 4) from effects c, or their means over a time."""
        return np.asarray((curved - self.curved(self.trim)) @ self.matrix.T)


class ServoLag:
    """First-order lag between the commanded and the actual deflection."""

    def __init__(
        self,
        time_constant: float,  # s; 0 for none
        h: float,  # Cell width, s
    ) -> None:
        self.time_constant, self._ratio = time_constant, time_constant / h
        self._filter: BlockFilter | None = None
        if time_constant > 0.0:
            a = np.array([[-1.0 / time_constant]])
            self._filter = BlockFilter(a, -a[0], h, len(INPUTS))

    def apply(self, u: FloatArray, *, restarted: bool) -> FloatArray:
        """Return cell means of the deflection from those of the command, shape (m, 4).

        If restarted, it begins in equilibrium at the first of them.
        """
        if self._filter is None:
            return u
        if restarted:
            self._filter.state = u[:1].copy()
        before = self._filter.state
        after = self._filter.apply(np.zeros((len(u) + 1, u.shape[1])), u)[0]
        start = np.concatenate([before, after[:-1]])
        # The equation of the lag, integrated over the cell: mean = u - T (s1 - s0) / h.
        return np.asarray(u - self._ratio * (after - start))


def cell_means(
    t_ns: TimeArray,  # (k,) Stamps of the samples, ns; the first is at or before the first edge
    u: FloatArray,  # (k, N) Values; each applies from its stamp on, the last without limit
    edges_ns: TimeArray,  # (m + 1,) Edges of the cells, ns, already shifted by the delay
    interpolation: str,  # ``hold`` or ``linear``
) -> FloatArray:
    """Return exact means of a sampled input over cells, (m, N).

    Sampling at the end of a cell would be half a sample off.
    """
    last = t_ns.searchsorted(edges_ns, side="right") - 1
    since = (edges_ns - t_ns.take(last))[:, None]
    width = (t_ns[1:] - t_ns[:-1])[:, None]
    integral = np.zeros(u.shape)
    if interpolation == "linear":
        slope = np.zeros_like(u)
        slope[:-1] = (u[1:] - u[:-1]) / width
        np.add.accumulate((u[:-1] + 0.5 * slope[:-1] * width) * width, out=integral[1:])
        at_edges = integral[last] + (u[last] + 0.5 * slope[last] * since) * since
    else:
        np.add.accumulate(u[:-1] * width, out=integral[1:])
        at_edges = integral.take(last, axis=0) + u.take(last, axis=0) * since
    return np.asarray((at_edges[1:] - at_edges[:-1]) / (edges_ns[1:] - edges_ns[:-1])[:, None])


# --- the grid -------------------------------------------------------------------------------------


RATE_SAMPLES = 4 * IN_A_ROW
"""Intervals that determine the Imu's rate: two losses of `IN_A_ROW` do not affect their median."""

FASTEST_CELL_NS = 1_000_000
"""Shortest cell, ns: 1 kHz, the highest useful Imu rate."""

SHORTEST_LOSS_NS = round(2.0 * SAMPLE_TIME / NS)
"""Shortest time after which an input counts as lost, ns: the filters hide two or three messages
lost on a radio link."""

Edges = TypeVar("Edges", TimeArray, FloatArray)

STEADY_RATE = 0.1
"""Largest mean and standard deviation of the rates in steady flight, rad/s."""


@dataclass
class Block:
    """Signals over m consecutive cells of the grid, body axes FRD."""

    t_ns: TimeArray  # (m + 1,) Edges of the cells, ns
    h: float  # Cell width, s
    # (m + 1, 3) Measured state of the model at the edges: p, q, r, rad/s. Once the flow angles are
    # observed, (m + 1, 8), with sideslip and angle of attack, rad, and the unit vector that points
    # down
    state: FloatArray
    u: FloatArray  # (m, 4) Means of de, dr, da, dth over the cells, delayed and lagged
    # (m + 1, 3) Specific forces ax, ay, az at the edges, m/s^2; ay, az less their centripetal part
    specific_force: FloatArray
    restarted: bool  # Whether the block does not continue the previous one
    # (m, 4) Injected part of `u`; None before there was any
    excitation: FloatArray | None = None
    # (m, 4) Means of lines through the inputs at the edges, less `u`: such a line begins a jump a
    # cell sooner. None for inputs that do not jump
    early: FloatArray | None = None
    # (m, 2) Means of the part of ay, az that an offset accelerometer adds while the rates change,
    # m/s^2; None where it is not offset
    by_turning: FloatArray | None = None
    airspeed: float | None = None  # True, m/s; None until the flow angles are observed

    def __post_init__(self) -> None:
        self.x = self.state[:, :3]  # (m + 1, 3) Rates p, q, r at the edges, rad/s
        self.force = self.specific_force[:, 1:]  # (m + 1, 2) ay, az at the edges, m/s^2
        self.time = self.h * len(self.u)  # Length of the block, s
        # State of the identified model at the edges, as `state`; the measured one before its run
        self.model_state = self.state
        self.injected = False  # Whether it is the response to the injected part of `u` alone


def join(blocks: Sequence[Block]) -> Block:
    """Join blocks that continue one another."""
    if len(blocks) == 1:
        return blocks[0]

    def of_cells(parts: list[FloatArray | None]) -> FloatArray | None:
        """Join values of cells; None counts as zeros if there are others."""
        if all([values is None for values in parts]):
            return None
        both = zip(parts, blocks, strict=True)
        return np.concatenate([np.zeros_like(b.u) if v is None else v for v, b in both])

    first = blocks[0]
    joined = Block(
        edge_values([block.t_ns for block in blocks]),
        first.h,
        edge_values([block.state for block in blocks]),
        np.concatenate([block.u for block in blocks]),
        edge_values([block.specific_force for block in blocks]),
        first.restarted,
        of_cells([block.excitation for block in blocks]),
        of_cells([block.early for block in blocks]),
        of_cells([block.by_turning for block in blocks]),
        first.airspeed,
    )
    joined.model_state = edge_values([block.model_state for block in blocks])
    joined.injected = first.injected
    return joined


def edge_values(parts: Sequence[Edges]) -> Edges:
    """Join edge values of blocks, of which neighbours share an edge."""
    return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])


class Sampler:
    """Resampler of rates and inputs to the grid."""

    def __init__(self, settings: Settings) -> None:
        self._frame = BodyFrame(settings.imu)
        self._arm = np.array(settings.imu.lever_arm)
        self._lever = lever_arm_matrix(self._arm)
        self._offset = bool(self._arm.any())
        self._actuators = settings.actuators
        self._max_gap_ns = round(settings.filter.max_gap * NS_PER_S)
        self._timeout_ns = round(settings.actuators.timeout * NS_PER_S)
        self.input_map = InputMap(settings.actuators)
        self._trim_known = settings.actuators.learn_trim_time == 0.0
        self.rates = SampleBuffer(6)
        self.raw_inputs = SampleBuffer(len(settings.actuators.channels))
        self.injected = SampleBuffer(len(INPUTS))
        # Delay and lag of the inputs, s; a change of the lag begins a new stretch of blocks
        self.delay, self.time_constant = settings.actuators.delay, settings.actuators.time_constant
        self._memory_ns = round(MAX_DELAY * NS_PER_S)
        self._linear = settings.actuators.interpolation == "linear"
        self.restart()

    def restart(self) -> None:
        """Drop all samples and the Imu's rate; a learned trim stays."""
        self.rates.clear()
        self.raw_inputs.clear()
        self.injected.clear()
        self.h_ns: int | None = None
        self._lags: tuple[ServoLag, ServoLag] | None = None  # Of the inputs and their injected part
        self._stale_ns = self._timeout_ns  # last computed `_stale_age`
        self._edge_ns: int | None = None
        self._continues = False
        self.waiting_for = "rates"

    def held(self, t_ns: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return the newest x (3,), u (4,) and ay, az (2,) at `t_ns`, as the paper samples them.

        None if they are missing or stale.
        """
        at = t_ns - round(self.delay * NS_PER_S)
        self.rates.trim(t_ns)
        self.raw_inputs.trim(t_ns - self._memory_ns)
        last = self.raw_inputs.after(at) - 1
        self.waiting_for = "rates" if not len(self.rates.t) else "actuators" if last < 0 else ""
        if self.waiting_for:
            return None
        rates_age = t_ns - int(self.rates.t[-1])
        if rates_age > self._max_gap_ns or at - int(self.raw_inputs.t[last]) > self._timeout_ns:
            self.waiting_for = "fresh samples"
            return None
        signals = self.rates.v[-1]
        u = self.input_map.apply(self.raw_inputs.v[last])
        x = self._frame.to_body(signals[:3])
        return x, u, self._frame.to_body(signals[3:])[1:] - centripetal(x, self._arm)

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks that are complete with the samples in use."""
        self.waiting_for = ""  # Which of rates, inputs and trim is missing
        if self.h_ns is None and len(self.rates.t) <= RATE_SAMPLES:
            self.waiting_for = "rates"
            return
        if self.h_ns is None:
            self.h_ns = max(int(np.median(np.diff(self.rates.t))), FASTEST_CELL_NS)
        if not len(self.raw_inputs.t):
            self.rates.trim(int(self.rates.t[-1]))
            self.waiting_for = "actuators"
            return
        if not self._trim_known and not self._learn_trim():
            self.waiting_for = "steady flight to learn the trim from"
            return
        t, breaks = self.rates.t, []
        if t[-1] - t[0] > self._max_gap_ns:
            breaks = np.flatnonzero(t[1:] - t[:-1] > self._max_gap_ns).tolist()
        # From gap to gap
        for begin, end in zip([0, *(i + 1 for i in breaks)], [*breaks, -1], strict=True):
            first_ns = int(t[begin])
            yield from self._cut(first_ns, int(t[end]))
        # Samples before the next cell are not needed; a run of one sample has no cell yet.
        needed = first_ns if self._edge_ns is None else max(first_ns, self._edge_ns)
        self.rates.trim(needed)
        self.raw_inputs.trim(needed - self._memory_ns)
        self.injected.trim(needed - self._memory_ns)

    def hold_delay(self) -> float:
        """Return the mean age of an input that is held until the next sample, s."""
        if self._linear or len(self.raw_inputs.t) < 2:
            return 0.0
        steps: list[int] = np.diff(self.raw_inputs.t).tolist()
        return 0.5 * NS * median(steps)  # faster than NumPy's

    def _stale_age(self) -> int:
        """Return the age, ns, at which an input counts as lost.

        Holding its last value for longer would bias the control derivatives.
        """
        steps = np.diff(self.raw_inputs.t)
        if len(steps) >= IN_A_ROW:
            steps.sort()
            usual = int(steps[3 * len(steps) // 4])
            self._stale_ns = min(self._timeout_ns, max(IN_A_ROW * usual, SHORTEST_LOSS_NS))
        return self._stale_ns

    def _learn_trim(self) -> bool:
        """Set the trim to the mean raw channels of the first steady stretch, if there is one."""
        span_ns = round(self._actuators.learn_trim_time * NS_PER_S)
        newest = int(self.rates.t[-1])
        if newest - int(self.rates.t[0]) < span_ns:
            return False
        self.rates.trim(newest - span_ns)
        self.raw_inputs.trim(newest - span_ns)
        x = self.rates.v[:, :3]
        spread = np.maximum(np.abs(x.mean(axis=0)), x.std(axis=0))
        window = np.array([newest - span_ns, newest], dtype=np.int64)
        if spread.max() > STEADY_RATE or self._known_runs(window, self._timeout_ns) != [(0, 2)]:
            return False
        # Mean over time, not over samples: some publishers send changes only.
        mean = cell_means(
            self.raw_inputs.t, self.raw_inputs.v, window, self._actuators.interpolation
        )
        self.input_map.trim = mean[0]
        self._trim_known = True
        return True

    def _cut(self, first_ns: int, last_ns: int) -> Iterator[Block]:
        """Yield the blocks within one gap-free stretch, cut where the inputs are unknown."""
        assert self.h_ns is not None
        if self._lags is None or self._lags[0].time_constant != self.time_constant:
            own, injected = (ServoLag(self.time_constant, self.h_ns * NS) for _ in range(2))
            self._lags, self._continues = (own, injected), False
        start = self._edge_ns
        if start is None or start < first_ns:
            start, self._continues = first_ns, False
        delay_ns = round(self.delay * NS_PER_S)
        if self._linear:
            # Interpolation needs the next sample: cells wait for it, up to the stale age.
            newest = int(self.raw_inputs.t[-1]) + delay_ns
            if last_ns - newest <= self._stale_age():
                last_ns = min(last_ns, newest)
        edges = np.arange(start, last_ns + 1, self.h_ns, dtype=np.int64)
        if len(edges) < 2:
            return
        at = edges - delay_ns
        runs = self._known_runs(at)
        for begin, end in runs:
            if end - begin > 1:
                run = slice(begin, end)
                yield self._block(edges[run], at[run], begin > 0 or not self._continues)
                self._continues = True
        self._continues = bool(runs) and runs[-1][1] == len(edges) and end - begin > 1
        self._edge_ns = int(edges[-1])

    def _known_runs(self, at: TimeArray, stale_ns: int | None = None) -> list[tuple[int, int]]:
        """Return begin and end (exclusive) of each run of times with an input that is not stale.

        An input is stale if older than `stale_ns`, or than `_stale_age` if that is omitted.
        """
        t = self.raw_inputs.t
        first = self.raw_inputs.after(at[0]) - 1
        fresh_ns = min(self._timeout_ns, SHORTEST_LOSS_NS)
        if first >= 0 and at[-1] - t[first] <= fresh_ns and not self._linear:
            return [(0, len(at))]  # nearly always
        stale_ns = self._stale_age() if stale_ns is None else stale_ns
        last = t.searchsorted(at, side="right") - 1
        begin = t[np.maximum(last, 0)]
        if self._linear:
            end = t[np.minimum(t.searchsorted(at), len(t) - 1)]
            known = (last >= 0) & (at <= end) & (end - begin <= stale_ns)
        else:
            known = (last >= 0) & (at - begin <= stale_ns)
        flips = np.flatnonzero(np.diff(known.astype(np.int8), prepend=0, append=0)).tolist()
        return list(zip(flips[::2], flips[1::2], strict=True))

    def _block(self, edges: TimeArray, at: TimeArray, restarted: bool) -> Block:
        """Return the signals over the cells between `edges`, with inputs commanded at `at`."""
        assert self.h_ns is not None and self._lags is not None
        lag, injected_lag = self._lags
        signals = self.rates.interpolate(edges).reshape(-1, 2, 3)
        x, force = self._frame.to_body(signals).transpose(1, 0, 2)
        by_turning = None
        if self._offset:
            force[:, 1:] -= centripetal(x, self._arm)
            by_turning = (x[1:] - x[:-1]) @ self._lever.T / (self.h_ns * NS)
        raw = self.raw_inputs
        done = self.input_map.curved(raw.v)
        means = cell_means(raw.t, done, at, self._actuators.interpolation)
        u, injected = lag.apply(self.input_map.mix(means), restarted=restarted), None
        if len(self.injected.t):
            t, v = with_zeros(self.injected.t, self.injected.v, int(at[0]))
            injected = injected_lag.apply(cell_means(t, v, at, "hold"), restarted=restarted)
        early = None
        if not self._linear and self.time_constant == 0.0:
            jumping = self.input_map.mix(done[raw.t.searchsorted(at, side="right") - 1])
            early = 0.5 * (jumping[1:] + jumping[:-1]) - u
        return Block(edges, self.h_ns * NS, x, u, force, restarted, injected, early, by_turning)


def with_zeros(
    t_ns: TimeArray,  # (k,) Stamps, ns, rising
    v: FloatArray,  # (k, 4) Values; each counts until the next, or for `EXCITATION_TIMEOUT`
    first_ns: int,  # Time from which values are needed, ns
) -> tuple[TimeArray, FloatArray]:
    """Return an excitation stream with zeros before its start and in its pauses."""
    timeout_ns = round(EXCITATION_TIMEOUT * NS_PER_S)
    silent = np.append(np.diff(t_ns) > timeout_ns, True)
    stamps = np.concatenate([t_ns, t_ns[silent] + timeout_ns])
    values = np.concatenate([v, np.zeros_like(v[silent])])
    if t_ns[0] > first_ns:
        stamps, values = np.append(stamps, first_ns), np.append(values, np.zeros_like(v[:1]), 0)
    order = np.argsort(stamps, kind="stable")
    return stamps[order], values[order]
