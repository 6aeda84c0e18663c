# SPDX-License-Identifier: Apache-2.0
"""Blocks that are alike, joined: what is learned from at once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from uav_ident_ros.identification.sampling import Block, edge_values, join
from uav_ident_ros.identification.structure import FloatArray


class Stretch(NamedTuple):
    """Blocks that continue one another, and what the identifier made of them."""

    block: Block  # Measured signals over m cells
    states: FloatArray  # (m + 1, 3 or 8) State of the identified model at the edges
    learns: bool  # Whether the gates let it be learned from
    readable: bool  # Whether it may be scored
    injected: bool  # Whether the states answer what was injected on purpose alone
    blocks: int = 1  # Number of blocks, one a tick

    @property
    def kind(self) -> tuple[bool, bool, bool]:
        """What those must have alike that are joined."""
        return self.learns, self.readable, self.injected


class Stretches:
    """Joins blocks to stretches."""

    def __init__(self) -> None:
        self._parts: list[Stretch] = []

    def add(self, part: Stretch, length: float) -> Iterator[Stretch]:
        """Take a block; yield the stretches that end with it or before it, at `length` s."""
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
