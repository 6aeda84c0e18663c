# SPDX-License-Identifier: Apache-2.0
"""What is learned from at once: the blocks of several ticks, and the model's run beside them.

The model follows the aircraft tick by tick. Learning takes a stretch of some ticks together: the
cost of an update hardly depends on how many samples it takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.model import FlowSignals
from uav_ident_ros.identification.sampling import Block, join
from uav_ident_ros.identification.structure import FloatArray

STRETCH_TIME = 0.1
"""Length of a stretch, s. With a quarter second, what the last moments tell of the trim comes late:
a point of the fit of recorded flights."""


@dataclass(frozen=True)
class Stretch:
    """Signals over m consecutive cells, and the state of the model beside them.

    Parameters
    ----------
    block : Block
        Measured signals.
    flow : FlowSignals or None
        Flow angles and attitude; for a structure that has them.
    states : (m + 1, 3 or 8) array
        State of the identified model at the edges.
    learns : bool
        Whether the gates let it be learned from.
    readable : bool
        Whether it may be scored.
    injected : bool
        Whether the states are the response to what was injected on purpose alone.
    """

    block: Block
    flow: FlowSignals | None
    states: FloatArray
    learns: bool
    readable: bool
    injected: bool

    def continued_by(self, other: Stretch) -> bool:
        """Whether another one may be joined to it."""
        alike = (self.learns, self.readable, self.injected)
        return not other.block.restarted and alike == (other.learns, other.readable, other.injected)


def join_stretches(parts: Sequence[Stretch]) -> Stretch:
    """Make one stretch of parts that continue one another."""
    first, last = parts[0], parts[-1]
    if len(parts) == 1:
        return first
    flow = None
    if last.flow is not None:
        flows = [part.flow for part in parts if part.flow is not None]
        angles, down = _edges([f.angles for f in flows]), _edges([f.down for f in flows])
        flow = FlowSignals(angles, down, last.flow.airspeed)
    return Stretch(
        join([part.block for part in parts]),
        flow,
        _edges([part.states for part in parts]),
        first.learns,
        first.readable,
        first.injected,
    )


def _edges(parts: Sequence[FloatArray]) -> FloatArray:
    """Values at the edges of all cells, from those of blocks that share an edge."""
    return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
