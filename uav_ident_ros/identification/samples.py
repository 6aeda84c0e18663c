# SPDX-License-Identifier: Apache-2.0
"""A stream of stamped samples: taken as they come, used in order of their stamps."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.structure import BoolArray, FloatArray

TimeArray = NDArray[np.int64]

NS = 1e-9
"""Seconds in a nanosecond."""


class SampleBuffer:
    """Samples of one stream, cheap to append to.

    Parameters
    ----------
    width : int
        Values per sample.

    Attributes
    ----------
    t : (k,) int array
        Stamps of the samples in use, ns, strictly rising.
    v : (k, width) array
        Their values.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self.clear()

    def clear(self) -> None:
        """Drop everything."""
        self._waiting_t: list[int] = []
        self._waiting_v: list[Sequence[float]] = []
        self._ordered = True
        self.t: TimeArray = np.empty(0, dtype=np.int64)
        self.v: FloatArray = np.empty((0, self._width))

    def append(self, t_ns: int, values: Sequence[float]) -> None:
        """Keep a sample until a tick at or after its stamp asks for it."""
        if self._waiting_t and t_ns <= self._waiting_t[-1]:
            self._ordered = False
        self._waiting_t.append(t_ns)
        self._waiting_v.append(values)

    def call_off(self, t_ns: int) -> None:
        """Drop what waits and is stamped at or after `t_ns`."""
        kept = [i for i, t in enumerate(self._waiting_t) if t < t_ns]
        self._waiting_t = [self._waiting_t[i] for i in kept]
        self._waiting_v = [self._waiting_v[i] for i in kept]

    def forget_waiting(self, newest_ns: int, span_ns: int) -> None:
        """Keep only the last `span_ns` of what waits, where nothing asks for it yet.

        The span may be exceeded twofold, so that the work is not done at every sample.
        """
        if self._waiting_t and self._waiting_t[0] < newest_ns - 2 * span_ns:
            kept = [i for i, t in enumerate(self._waiting_t) if t >= newest_ns - span_ns]
            self._waiting_t = [self._waiting_t[i] for i in kept]
            self._waiting_v = [self._waiting_v[i] for i in kept]

    def merge(self, t_ns: int) -> int:
        """Bring the samples stamped at or before `t_ns` into use.

        Of samples with one stamp the first to arrive counts.

        Returns
        -------
        int
            Number of duplicates dropped.
        """
        if not self._waiting_t:
            return 0
        duplicates = 0 if self._ordered else self._order()
        ready = bisect_right(self._waiting_t, t_ns)
        if ready:
            self.t = np.concatenate((self.t, np.array(self._waiting_t[:ready], dtype=np.int64)))
            self.v = np.concatenate((self.v, np.array(self._waiting_v[:ready], dtype=np.float64)))
            del self._waiting_t[:ready], self._waiting_v[:ready]
        return duplicates

    def _order(self) -> int:
        """Put what waits in order of the stamps; return the number of duplicates dropped."""
        before = len(self._waiting_t)
        first = dict(zip(reversed(self._waiting_t), reversed(self._waiting_v), strict=True))
        self._waiting_t = sorted(first)
        self._waiting_v = [first[t] for t in self._waiting_t]
        self._ordered = True
        return before - len(self._waiting_t)

    def leave_out(self, which: BoolArray) -> None:
        """Drop some of the newest samples in use, chosen by a bool array of their number."""
        kept = np.append(np.ones(len(self.t) - len(which), dtype=bool), ~which)
        self.t, self.v = self.t[kept], self.v[kept]

    def after(self, t_ns: int) -> int:
        """Index of the first sample in use that is stamped after `t_ns`."""
        return int(self.t.searchsorted(t_ns, side="right"))

    def trim(self, t_ns: int) -> None:
        """Drop the samples in use before the last one at or before `t_ns`."""
        if len(self.t) and (first := self.after(t_ns) - 1) > 0:
            self.t, self.v = self.t[first:], self.v[first:]

    def interpolate(self, t_ns: TimeArray) -> FloatArray:
        """Straight lines through the samples in use, at `t_ns` within their span.

        Returns
        -------
        (len(t_ns), width) array
            The values.
        """
        if len(self.t) == len(t_ns) and (self.t == t_ns).all():
            return self.v
        right = np.maximum(self.t.searchsorted(t_ns), 1)
        left = right - 1
        since, low = self.t.take(left), self.v.take(left, axis=0)
        share = (t_ns - since) / (self.t.take(right) - since)
        return low + share[:, None] * (self.v.take(right, axis=0) - low)
