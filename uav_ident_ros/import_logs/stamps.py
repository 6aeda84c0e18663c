# SPDX-License-Identifier: Apache-2.0
"""Stamps of a stream: rate, gaps, coverage, and interpolation to other times."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view as windows

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import BoolArray, FloatArray
from uav_ident_ros.messages.types import NS_PER_S

Stretches = Sequence[tuple[int, int]]
"""Start and end of stretches of time, ns."""

GAP_INTERVALS, SHORTEST_GAP = 3.0, 0.02
"""Shortest gap, in median intervals and in s; both must be exceeded. Jitter stays below, and one or
two lost samples hardly matter."""

BEYOND_STAMPS_NS = 2**31 * NS_PER_S
"""First time beyond the range of a ROS stamp, ns."""

NEIGHBOURS = 5
"""Number of stamps in the running median: it detects up to two damaged ones in a row."""

FARTHEST_NS, FARTHEST_STEPS = 1_000_000_000, 20
"""Largest distance of a plausible stamp from the median of its neighbours, in ns and in median
intervals; the larger limit counts. The node, too, allows jumps of a second (time_jump)."""

LONGEST_HOLD_NS = 500_000_000
"""Time that a sample covers after its stamp, ns: five intervals of a stream logged at 10 Hz. The
identifier does not learn from older commands."""


def plausible(t_ns: TimeArray) -> BoolArray:
    """Return whether each stamp can come from a clock, relative to the stamps around it.

    An implausible stamp is far from the median of its neighbours, and later than those after it or
    earlier than those before it. A stamp at either end of a long gap is plausible.
    """
    result = (t_ns >= 0) & (t_ns < BEYOND_STAMPS_NS)
    stamps = t_ns[result]
    if len(stamps) < NEIGHBOURS:
        return np.asarray(result)
    farthest = max(FARTHEST_NS, FARTHEST_STEPS * float(np.median(np.abs(np.diff(stamps)))))
    around = np.pad(stamps, NEIGHBOURS // 2, mode="reflect")
    lone = np.abs(stamps - np.median(windows(around, NEIGHBOURS), axis=1)) > farthest
    near = windows(np.pad(stamps, NEIGHBOURS, constant_values=(0, BEYOND_STAMPS_NS)), NEIGHBOURS)
    before, after = near[: len(stamps)].max(axis=1), near[-len(stamps) :].min(axis=1)
    result[result] = ~(lone & ((stamps > after + farthest) | (stamps < before - farthest)))
    return np.asarray(result)


def rate(t_ns: TimeArray) -> float:
    """Return the rate of a stream, Hz, from its median interval; 0 if there is none."""
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return float(NS_PER_S / np.median(steps)) if len(steps) else 0.0


def describe(t_ns: TimeArray) -> str:
    """Return number of samples, duration and rate of a stream, in words."""
    if not len(t_ns):
        return "no samples"
    seconds = float(np.max(t_ns) - np.min(t_ns)) / NS_PER_S
    return f"{len(t_ns)} samples over {seconds:.1f} s at {rate(t_ns):.4g} Hz"


def irregularities(t_ns: TimeArray) -> list[str]:
    """Return the defects of a stream's stamps, in words: gaps, repetitions, steps back."""
    steps = np.diff(t_ns)
    result = []
    if back := int((steps < 0).sum()):
        result.append(f"{back} stamps are earlier than the one before")
    if same := int((steps == 0).sum()):
        result.append(f"{same} stamps repeat the one before")
    if not (usual := rate(t_ns)):
        return result
    limit = max(GAP_INTERVALS / usual, SHORTEST_GAP)
    gaps = steps > limit * NS_PER_S
    if count := int(gaps.sum()):
        longest, seconds = int(np.argmax(steps)), steps / NS_PER_S
        result.append(
            f"{count} gap{'s' if count > 1 else ''} of more than {limit:.3g} s, together "
            f"{seconds[gaps].sum():.3g} s, the longest {seconds[longest]:.3g} s at "
            f"{t_ns[longest] / NS_PER_S:.2f} s"
        )
    return result


def inside(t_ns: TimeArray, stretches: Stretches) -> BoolArray:
    """Return whether each stamp lies in one of some stretches."""
    result = np.zeros(len(t_ns), dtype=bool)
    for start, end in stretches:
        result |= (start <= t_ns) & (t_ns <= end)
    return result


def coverage(t_ns: TimeArray, stretches: Stretches, hold_ns: int = LONGEST_HOLD_NS) -> float:
    """Return the share of some stretches that a stream covers; a sample lasts `hold_ns`."""
    covered = whole = 0
    for start, end in stretches:
        stamps = t_ns[inside(t_ns, [(start, end)])]
        covered += int(np.clip(np.diff(stamps, append=end), 0, hold_ns).sum())
        whole += end - start
    return min(covered / whole, 1.0) if whole else 0.0


def intervals(
    t_ns: TimeArray,  # (k,) Stamps of the state, ns
    active: BoolArray,  # (k,) Whether the state holds from the stamp to the next
    end_ns: int,  # End of the log, ns
) -> list[tuple[int, int]]:
    """Return the stretches in which a logged state holds."""
    changes = np.flatnonzero(np.diff(active.astype(int), prepend=0, append=0))
    edges = np.append(t_ns, end_ns)[changes].tolist()
    return [(begin, end) for begin, end in zip(edges[::2], edges[1::2], strict=True) if end > begin]


def hold(t_ns: TimeArray, samples_ns: TimeArray, values: FloatArray) -> FloatArray:
    """Return the last value at or before each time, NaN before the first, (n, C)."""
    index = np.searchsorted(samples_ns, t_ns, side="right") - 1
    held = np.array(values[np.maximum(index, 0)], dtype=float)
    held[index < 0] = np.nan
    return held


def interpolate(t_ns: TimeArray, samples_ns: TimeArray, values: FloatArray) -> FloatArray:
    """Return values (k, C), interpolated linearly to other times, (n, C)."""
    origin = int(samples_ns[0])
    at, known = (t_ns - origin).astype(float), (samples_ns - origin).astype(float)
    return np.column_stack([np.interp(at, known, column) for column in values.T])


def turned_at(t_ns: TimeArray, samples_ns: TimeArray, quaternion: FloatArray) -> FloatArray:
    """Return unit quaternions (k, 4), interpolated along the shorter arcs to times (n,)."""
    flips = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    joined = interpolate(t_ns, samples_ns, quaternion * np.append(1.0, flips)[:, None])
    return np.asarray(joined / np.linalg.norm(joined, axis=1, keepdims=True))
