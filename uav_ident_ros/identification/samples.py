# SPDX-License-Identifier: Apache-2.0
"""Intake of samples: checks, outliers, buffers, and the ticks that become due.

Tick k is at message time ``k / update_rate``. It is due when the newest stamp of the rates has
passed it by `input_wait`, and uses every sample stamped at or before it.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from fractions import Fraction
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.scales import IN_A_ROW, INDEPENDENT_TIME, STEP
from uav_ident_ros.identification.settings import LARGEST_NUMBER, MAX_DELAY, Settings
from uav_ident_ros.identification.structure import INPUTS, BoolArray, FloatArray

TimeArray = NDArray[np.int64]

NS = 1e-9
"""Seconds in a nanosecond."""

NS_PER_S = 1_000_000_000


class SampleBuffer:
    """Samples of one stream: those waiting for their tick, and those in use."""

    def __init__(self, width: int) -> None:  # Values per sample
        self._width = width
        self.clear()

    def clear(self) -> None:
        """Drop everything."""
        # Samples that wait for a tick, in the order of the stamps
        self._waiting_t: list[int] = []
        self._waiting_v: list[Sequence[float]] = []
        # Samples in use: stamps, ns, strictly rising, and values, (k, width)
        self.t: TimeArray = np.empty(0, dtype=np.int64)
        self.v: FloatArray = np.empty((0, self._width))

    def append(self, t_ns: int, values: Sequence[float]) -> bool:
        """Store a sample until a tick at or after its stamp; return whether it was stored.

        Of samples with the same stamp only the first to arrive is stored.
        """
        at = bisect_left(self._waiting_t, t_ns)
        if self._waiting_t[at : at + 1] == [t_ns]:
            return False
        self._waiting_t.insert(at, t_ns)
        self._waiting_v.insert(at, values)
        return True

    def cancel(self, t_ns: int) -> None:
        """Drop the waiting samples stamped at or after `t_ns`."""
        first = bisect_left(self._waiting_t, t_ns)
        del self._waiting_t[first:], self._waiting_v[first:]

    def drop_old(self, newest_ns: int, span_ns: int) -> None:
        """Drop waiting samples older than `span_ns`, before there are any ticks.

        The span may be exceeded twofold, which avoids a deletion at every sample.
        """
        if self._waiting_t and self._waiting_t[0] < newest_ns - 2 * span_ns:
            first = bisect_left(self._waiting_t, newest_ns - span_ns)
            del self._waiting_t[:first], self._waiting_v[:first]

    def merge(self, t_ns: int) -> None:
        """Bring the samples stamped at or before `t_ns` into use."""
        ready = bisect_right(self._waiting_t, t_ns)
        if ready:
            self.t = np.concatenate((self.t, self._waiting_t[:ready]))
            self.v = np.concatenate((self.v, self._waiting_v[:ready]))
            del self._waiting_t[:ready], self._waiting_v[:ready]

    def leave_out(self, which: BoolArray) -> None:
        """Drop some of the newest samples in use, by a mask over them."""
        kept = np.append(np.ones(len(self.t) - len(which), dtype=bool), ~which)
        self.t, self.v = self.t[kept], self.v[kept]

    def after(self, t_ns: int) -> int:
        """Return the index of the first sample in use that is stamped after `t_ns`."""
        return int(self.t.searchsorted(t_ns, side="right"))

    def trim(self, t_ns: int) -> None:
        """Drop the samples in use before the last one at or before `t_ns`."""
        if len(self.t) and (first := self.after(t_ns) - 1) > 0:
            self.t, self.v = self.t[first:], self.v[first:]

    def interpolate(self, t_ns: TimeArray) -> FloatArray:
        """Return the samples in use, linearly interpolated at `t_ns` within their span."""
        if len(self.t) == len(t_ns) and (self.t == t_ns).all():
            return self.v
        right = np.maximum(self.t.searchsorted(t_ns), 1)
        left = right - 1
        since, low = self.t.take(left), self.v.take(left, axis=0)
        share = (t_ns - since) / (self.t.take(right) - since)
        return low + share[:, None] * (self.v.take(right, axis=0) - low)


# --- intake ---------------------------------------------------------------------------------------


RATES_STREAM, ACTUATORS, AIRSPEED, ARMED = "rates", "actuators", "airspeed", "armed"
EXCITATION = "excitation"
"""Names of the streams, the keys of `Intake.drops`."""

NO_TICK = -(2**62)
"""Time of the last tick before the first, ns."""

LARGEST_GYRO_RATE = math.pi / STEP
"""Rate that no aircraft reaches, rad/s: half a turn in a step of integration, 7200 deg/s."""

LARGEST_MOTION = 1000.0
"""Specific force, m/s^2, and airspeed, m/s, that no aircraft survives."""

LATEST_STAMP = (2**31 - 1) * NS_PER_S
"""Last time that a ROS stamp can hold, ns: later ticks cannot be published."""


class Drop(StrEnum):
    """Reason why a sample was dropped."""

    NOT_FINITE = "not finite"
    WRONG_LENGTH = "wrong number of values"
    ZERO_STAMP = "zero or negative stamp"
    BEYOND_STAMP = "stamp beyond 2038"
    OUTLYING_STAMP = "outlying stamp"
    IMPLAUSIBLE = "implausibly large"
    GLITCH = "out of range for an instant"
    SPIKE = "far from the samples before and after"
    LATE = "late"
    DUPLICATE = "repeated stamp"
    CLOCK_MISMATCH = "stamp far from the Imu's"


def sample_problem(t_ns: int, *parts: tuple[Sequence[float], int, float]) -> Drop | None:
    """Return the problem of a sample; None if it is valid.

    Each of the parts is some values, their number, and the largest magnitude that they may have.
    """
    for values, count, largest in parts:
        if len(values) != count:
            return Drop.WRONG_LENGTH
        if not math.isfinite(sum(values)):
            return Drop.NOT_FINITE
        if max(map(abs, values)) > largest:
            return Drop.IMPLAUSIBLE
    if t_ns <= 0:
        return Drop.ZERO_STAMP
    return Drop.BEYOND_STAMP if t_ns > LATEST_STAMP else None


class SideStream(NamedTuple):
    """A stream beside that of the rates."""

    width: int  # Number of values of a sample
    largest: float  # Magnitude that none of them may exceed
    # Whether a late sample counts from the next tick on: it may not be sent again
    kept_if_late: bool = False
    cancels: bool = False  # Whether a sample cancels earlier ones with a later stamp


USUAL = 4 * IN_A_ROW
"""Samples that determine the usual offset between two streams."""

STEP_PERSISTS_NS = round(INDEPENDENT_TIME / NS)
"""Time for which a step must persist before it is accepted, ns: a queue of messages is shorter."""

STEP_NS = round(STEP / NS)
"""Smallest clock step that is not jitter, ns: the inputs are later by one integration step."""


class ClockSteps:
    """Detection and removal of steps of a stream's clock against that of the rates.

    A clock that is set by the network or an autopilot's time synchronisation steps once. Its stamps
    then skip or repeat some time, while those of the rates continue. Estimates hold for the clock
    before the step. A pause of either stream is not a step, nor is a message with a longer latency:
    then the usual offset returns as soon as the other messages have arrived.
    """

    def __init__(self) -> None:
        self.steps: list[int] = []  # Size of each, ns, until it is taken from here to be named
        self.correction_ns = 0  # Sum of all so far, which is subtracted from the stamps, ns
        # Of the last samples: stamps, and their offsets from the newest stamp of the rates, ns
        self._stamps: deque[int] = deque(maxlen=USUAL)
        self._offsets: deque[int] = deque(maxlen=USUAL)
        self._after: list[tuple[int, int]] = []  # stamps and offsets since a possible step

    def corrected(self, t_ns: int, newest_ns: int | None) -> int:
        """Return the stamp of a sample without the clock's steps, ns.

        `newest_ns` is the newest stamp of the rates at its arrival; None before any.
        """
        t_ns -= self.correction_ns
        if newest_ns is None:
            return t_ns
        offset = t_ns - newest_ns
        if self._after:
            jitter = max(self._offsets) - min(self._offsets)
            if abs(offset - self._after[0][1]) <= STEP_NS + jitter:
                self._after.append((t_ns, offset))
                return t_ns - self._confirmed_step()
            self._count(self._after)
        if self._deviates(t_ns, offset):
            self._after = [(t_ns, offset)]
        else:
            self._count([(t_ns, offset)])
        return t_ns

    def _deviates(self, t_ns: int, offset: int) -> bool:
        """Whether a stamp has neither the usual interval nor the usual offset from the rates.

        After a pause of the stream it is not judged: delayed samples may have been lost as well.
        """
        if len(self._stamps) < USUAL:
            return False
        low, high = min(self._offsets) - STEP_NS, max(self._offsets) + STEP_NS
        if low <= offset <= high:
            return False
        usual = float(np.median(np.diff(self._stamps)))
        since = t_ns - self._stamps[-1]
        by_rates = since - (offset - self._offsets[-1])
        return abs(since - usual) > STEP_NS and by_rates - usual <= high - low

    def _confirmed_step(self) -> int:
        """Return the size of the step, ns, once it is confirmed; else 0."""
        (first_ns, first), (last_ns, last) = self._after[0], self._after[-1]
        offset = float(np.mean([offset for _, offset in self._after]))
        size = round(offset - float(np.mean(self._offsets)))
        passed_ns = (last_ns - last) - (first_ns - first)  # on the rates' clock; may be late, too
        if len(self._after) < USUAL or passed_ns < max(abs(size), STEP_PERSISTS_NS):
            return 0
        size = size if abs(size) > STEP_NS else 0
        if size:
            self.steps.append(size)
            self.correction_ns += size
        self._count([(t - size, offset - size) for t, offset in self._after])
        return size

    def _count(self, samples: list[tuple[int, int]]) -> None:
        """Add samples to those that define the usual offset."""
        self._stamps.extend([t for t, _ in samples])
        self._offsets.extend([offset for _, offset in samples])
        self._after = []


Sample = tuple[int, Sequence[float], Sequence[float]]


class Intake:
    """Received samples of all streams, and the ticks that they make due."""

    def __init__(
        self,
        settings: Settings,
        # Restarts the whole pipeline on a new time base; it calls `restart`
        restart: Callable[[], None],
    ) -> None:
        channels = len(settings.actuators.channels)
        self._streams = {
            ACTUATORS: SideStream(channels, LARGEST_NUMBER),
            AIRSPEED: SideStream(1, LARGEST_MOTION),
            ARMED: SideStream(1, 1.0, kept_if_late=True),
            EXCITATION: SideStream(len(INPUTS), LARGEST_NUMBER, kept_if_late=True, cancels=True),
        }
        self._restart_all = restart
        self._rate = Fraction(settings.update_rate).limit_denominator(1_000_000)
        self._wait_ns = round(settings.input_wait * NS_PER_S)
        self._jump_ns = round(settings.time_jump * NS_PER_S)
        self._lookback_ns = round((MAX_DELAY + settings.actuators.timeout) * NS_PER_S)
        self._lookback_ns += 2 * self._jump_ns
        self.buffers: Mapping[str, SampleBuffer] = {}  # Those that receive the samples, by stream
        # For each stream the number of dropped samples by reason
        self.drops: dict[str, Counter[Drop]] = {
            name: Counter() for name in (RATES_STREAM, *self._streams)
        }
        self.fault = ""  # Problem of the clocks, evidence and cure; empty if none
        self.restart()

    def restart(self) -> None:
        """Begin a new time base: discard waiting samples and ticks."""
        self.newest_ns: int | None = None  # Newest stamp of the rates
        self._outlying: list[Sample] = []
        self._held: list[Callable[[], object]] | None = None
        self._mismatches = 0
        self.clock_steps = ClockSteps()  # Of the actuators
        self._due: deque[int] = deque()
        self._next_tick: int | None = None
        self.last_tick_ns = NO_TICK  # Last tick that was due or run

    @property
    def waiting(self) -> int:
        """Number of waiting ticks, outlying samples, and messages held back."""
        return len(self._due) + len(self._outlying) + len(self._held or ())

    # -- rates -----------------------------------------------------------------------------

    def add_rates(self, t_ns: int, pqr: Sequence[float], force: Sequence[float]) -> Drop | None:
        """Add a sample of rates and specific force; return why it was dropped, if it was."""
        if self._held is not None:
            self._held.append(partial(self.add_rates, t_ns, pqr, force))
            return None
        parts = (pqr, 3, LARGEST_GYRO_RATE), (force, 3, LARGEST_MOTION)
        problem = sample_problem(t_ns, *parts)
        if problem is None:
            far = self.newest_ns is not None and abs(t_ns - self.newest_ns) > self._jump_ns
            take = self._take_outlying if far else self._take_rates
            problem = take(t_ns, pqr, force)
        if problem is not None:
            self.drops[RATES_STREAM][problem] += 1
        return problem

    def _take_rates(self, t_ns: int, pqr: Sequence[float], force: Sequence[float]) -> Drop | None:
        newest = t_ns if self.newest_ns is None else max(t_ns, self.newest_ns)
        self.newest_ns = newest
        self._outlying.clear()
        if t_ns <= self.last_tick_ns:
            return Drop.LATE
        if not self.buffers[RATES_STREAM].append(t_ns, (*pqr, *force)):
            return Drop.DUPLICATE
        if self.last_tick_ns == NO_TICK:
            # The first samples may arrive in any order.
            first = t_ns * self._rate.numerator // (NS_PER_S * self._rate.denominator)
            first += self._tick_ns(first) < t_ns
            self._next_tick = first if self._next_tick is None else min(first, self._next_tick)
        assert self._next_tick is not None
        while (tick_ns := self._tick_ns(self._next_tick)) + self._wait_ns <= newest:
            self.last_tick_ns = tick_ns
            self._due.append(tick_ns)
            self._next_tick += 1
        return None

    def _take_outlying(
        self, t_ns: int, pqr: Sequence[float], force: Sequence[float]
    ) -> Drop | None:
        """Store an outlying sample; begin a new time base if enough agree and no tick is due."""
        outlying = self._outlying
        if outlying and not 0 < t_ns - outlying[-1][0] <= self._jump_ns:
            outlying.clear()
        outlying.append((t_ns, pqr, force))
        if len(outlying) < IN_A_ROW:
            return Drop.OUTLYING_STAMP
        self.newest_ns = t_ns
        self.drops[RATES_STREAM][Drop.OUTLYING_STAMP] -= len(outlying) - 1
        self._held = [partial(self.add_rates, *sample) for sample in outlying]
        if not self._due:
            self._take_held()
        return None

    def _take_held(self) -> None:
        """Begin the new time base with the samples held back for it."""
        held, self._held = self._held or [], None
        self._restart_all()
        for add in held:
            add()

    # -- the other streams -----------------------------------------------------------------

    def add(self, name: str, t_ns: int, values: Sequence[float], own: bool = False) -> Drop | None:
        """Add a sample of a stream beside the rates; return why it was dropped, if it was.

        An `own` sample was produced by a tick, and applies to the ticks that still wait.
        """
        if self._held is not None:
            self._held.append(partial(self.add, name, t_ns, values, own))
            return None
        if name == ACTUATORS:
            t_ns = self.clock_steps.corrected(t_ns, self.newest_ns)
        stream, buffer = self._streams[name], self.buffers[name]
        problem = sample_problem(t_ns, (values, stream.width, stream.largest))
        if problem is None:
            far = self.newest_ns is not None and abs(t_ns - self.newest_ns) > self._jump_ns
            late = t_ns <= self.last_tick_ns
            problem = Drop.CLOCK_MISMATCH if far else Drop.LATE if late else None
        if name == ACTUATORS:
            self._follow_clock(t_ns, problem)
        if problem is Drop.LATE and stream.kept_if_late:
            waited_for = own and bool(self._due) and t_ns >= self._due[0]
            t_ns, problem = t_ns if waited_for else self.last_tick_ns + 1, None
        if problem is None:
            if stream.cancels:
                buffer.cancel(t_ns)
            if not buffer.append(t_ns, values):
                problem = Drop.DUPLICATE
            elif self._next_tick is None:
                buffer.drop_old(t_ns, self._lookback_ns)
        if problem is not None:
            self.drops[name][problem] += 1
        return problem

    def _follow_clock(self, t_ns: int, problem: Drop | None) -> None:
        """Set or clear the fault that the actuators are stamped by another clock."""
        if problem is None or problem is Drop.LATE:
            self._mismatches, self.fault = 0, ""
        elif problem is Drop.CLOCK_MISMATCH and self.newest_ns is not None:
            self._mismatches += 1
            if self._mismatches >= IN_A_ROW:
                off = (t_ns - self.newest_ns) / NS_PER_S
                self.fault = (
                    f"the actuators are stamped {off:+.1f} s from the Imu: they run on different "
                    "clocks. Play a bag with --clock and set use_sim_time, or synchronise the "
                    "autopilot's time"
                )

    # -- ticks -----------------------------------------------------------------------------

    @property
    def due(self) -> int | None:
        """Time of the next tick that may be computed, ns; None if none is due."""
        return self._due[0] if self._due else None

    def ticks(self, until_ns: int) -> Iterator[int]:
        """Yield every tick up to and including `until_ns`, due or not."""
        while self._due and self._due[0] <= until_ns:
            yield self._due.popleft()
        if self._held is not None and not self._due:
            self._take_held()
            return
        while self._next_tick is not None and self._tick_ns(self._next_tick) <= until_ns:
            self.last_tick_ns = self._tick_ns(self._next_tick)
            self._next_tick += 1
            yield self.last_tick_ns

    def _tick_ns(self, k: int) -> int:
        return k * NS_PER_S * self._rate.denominator // self._rate.numerator
