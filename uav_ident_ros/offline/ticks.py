# SPDX-License-Identifier: Apache-2.0
"""The estimates of a flight, packed: an hour of them as objects would take a quarter of a GB."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import astuple, fields
from operator import attrgetter
from typing import Any, NamedTuple, overload

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray, Structure

_VECTORS = ("predicted_rates", "prediction_error", "fit")
_WORDS = ("adapting", "usable", "usable_rows", "state", "reason")
_FLOW = len(fields(FlowState))


class _Packed(NamedTuple):
    """An estimate."""

    t_ns: int
    numbers: FloatArray  # Free coefficients, their sigmas, `_VECTORS`, the flow state if any
    words: tuple[Any, ...]  # `_WORDS`; those of many ticks are one object


class Ticks(Sequence[Estimate]):
    """Estimates of one structure, in order."""

    def __init__(self, structure: Structure, estimates: Iterable[Estimate] = ()) -> None:
        self._structure = structure
        self._packed: list[_Packed] = []
        self._known: dict[Any, Any] = {}
        for estimate in estimates:
            self.append(estimate)

    def append(self, estimate: Estimate) -> None:
        """Add the next one."""
        mask = self._structure.mask
        flow = () if estimate.flow is None else astuple(estimate.flow)
        vectors = (getattr(estimate, name) for name in _VECTORS)
        numbers = (estimate.coefficients[mask], estimate.sigma[mask], *vectors, flow)
        words = attrgetter(*_WORDS)(estimate)
        words = self._known.setdefault(words, words)
        self._packed.append(_Packed(estimate.t_ns, np.concatenate(numbers), words))

    def chosen(self, which: Iterable[int]) -> Ticks:
        """Return those at some places, in their order; they share the numbers."""
        result = Ticks(self._structure)
        result._packed = [self._packed[k] for k in which]
        return result

    def joined(self, others: Iterable[Ticks]) -> Ticks:
        """Return these and then others; they share the numbers."""
        result = Ticks(self._structure)
        result._packed = sum((other._packed for other in others), self._packed)
        return result

    def __len__(self) -> int:
        return len(self._packed)

    @overload
    def __getitem__(self, item: int) -> Estimate: ...
    @overload
    def __getitem__(self, item: slice) -> Ticks: ...
    def __getitem__(self, item: int | slice) -> Estimate | Ticks:
        if isinstance(item, slice):
            return self.chosen(range(len(self))[item])
        t_ns, numbers, words = self._packed[item]
        mask, size = self._structure.mask, len(self._structure.free)
        values, sigma = np.zeros(mask.shape), np.zeros(mask.shape)
        values[mask], sigma[mask] = numbers[: 2 * size].reshape(2, -1)
        end = 2 * size + 3 * len(_VECTORS)
        vectors = numbers[2 * size : end].reshape(-1, 3).copy()
        flow = FlowState(*numbers[end:].tolist()) if len(numbers) == end + _FLOW else None
        named = dict(zip((*_VECTORS, *_WORDS), (*vectors, *words), strict=True))
        return Estimate(t_ns, values, sigma, flow=flow, **named)

    def stamps(self) -> TimeArray:
        """Return the ticks, ns, shape (K,)."""
        return np.array([packed.t_ns for packed in self._packed], dtype=np.int64)

    def history(self, index: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return one coefficient and its standard deviation over the ticks, (K,) each."""
        free = self._structure.free
        k, size = free.index(index), len(free)
        found = [(packed.numbers[k], packed.numbers[k + size]) for packed in self._packed]
        values, sigma = np.array(found).reshape(-1, 2).T
        return values.copy(), sigma.copy()
