# SPDX-License-Identifier: Apache-2.0
"""The estimates of a flight, packed: an hour of them as objects would take a quarter of a GB."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any, overload

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray, Structure

_VECTORS = ("predicted_rates", "prediction_error", "fit")
_FLOW = attrgetter(*(field.name for field in fields(FlowState)))
_NO_FLOW = np.zeros(len(fields(FlowState)))
_WORDS = ("adapting", "usable", "usable_rows", "state", "reason")
_SAID = attrgetter(*_WORDS)


class _Packed:
    """The numbers of all estimates in one array, their words in a table of different ones."""

    def __init__(self, structure: Structure) -> None:
        self.mask = structure.mask
        self.size = len(structure.free)
        self.width = 2 * self.size + 3 * len(_VECTORS) + len(_NO_FLOW)
        self.t_ns = array("q")
        self.numbers = array("d")
        self.words: list[Any] = []
        self.known: dict[Any, Any] = {}

    def table(self) -> FloatArray:
        """Numbers of all, (K, width); while it is in use nothing can be appended."""
        return np.frombuffer(self.numbers).reshape(-1, self.width)


class Ticks(Sequence[Estimate]):
    """Estimates of one structure, in order."""

    def __init__(
        self,
        structure: Structure,  # Their structure
        estimates: Iterable[Estimate] = (),  # The first of them
    ) -> None:
        self._structure = structure
        self._packed = _Packed(structure)
        self._which: TimeArray | None = None
        for estimate in estimates:
            self.append(estimate)

    def append(self, estimate: Estimate) -> None:
        """Add the next one."""
        packed = self._packed
        parts = [
            estimate.coefficients[packed.mask],
            estimate.sigma[packed.mask],
            *(getattr(estimate, name) for name in _VECTORS),
            _NO_FLOW if estimate.flow is None else _FLOW(estimate.flow),
        ]
        packed.numbers.frombytes(np.concatenate(parts).tobytes())
        packed.t_ns.append(estimate.t_ns)
        words = (_SAID(estimate), estimate.flow is not None)
        packed.words.append(packed.known.setdefault(words, words))

    def chosen(self, which: TimeArray) -> Ticks:
        """Return those at the places `which`; they share the numbers."""
        result = Ticks(self._structure)
        result._packed = self._packed
        result._which = which if self._which is None else self._which[which]
        return result

    @property
    def places(self) -> TimeArray:
        """Where they are among those that they were chosen from, (K,)."""
        return np.arange(len(self._packed.t_ns)) if self._which is None else self._which

    def __len__(self) -> int:
        return len(self._packed.t_ns if self._which is None else self._which)

    def __iter__(self) -> Iterator[Estimate]:
        return (self[i] for i in range(len(self)))

    @overload
    def __getitem__(self, item: int) -> Estimate: ...
    @overload
    def __getitem__(self, item: slice) -> Ticks: ...
    def __getitem__(self, item: int | slice) -> Estimate | Ticks:
        places = range(len(self))[item]
        if isinstance(places, range):
            return self.chosen(np.array(places, dtype=np.int64))
        packed = self._packed
        k = places if self._which is None else int(self._which[places])
        row = np.array(packed.numbers[k * packed.width : (k + 1) * packed.width])
        values, sigma = np.zeros(packed.mask.shape), np.zeros(packed.mask.shape)
        values[packed.mask], sigma[packed.mask] = row[: 2 * packed.size].reshape(2, -1)
        predicted, error, fit = row[2 * packed.size : -len(_NO_FLOW)].reshape(-1, 3)
        words, flies = packed.words[k]
        flow = FlowState(*row[-len(_NO_FLOW) :].tolist()) if flies else None
        said = dict(zip(_WORDS, words, strict=True))
        return Estimate(packed.t_ns[k], values, sigma, predicted, error, fit, flow=flow, **said)

    def stamps(self) -> TimeArray:
        """Return the ticks, ns, shape (K,)."""
        t_ns = np.array(self._packed.t_ns, dtype=np.int64)
        return t_ns if self._which is None else t_ns[self._which]

    def history(self, index: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return one coefficient and its standard deviation over the ticks, (K,) each."""
        packed, k = self._packed, self._structure.free.index(index)
        which = slice(None) if self._which is None else self._which
        table = packed.table()
        return table[which, k].copy(), table[which, k + packed.size].copy()
