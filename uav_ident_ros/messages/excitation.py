# SPDX-License-Identifier: Apache-2.0
"""Excitation messages: JointState whose names are the inputs de, dr, da, dth."""

from __future__ import annotations

import math
from typing import Any

from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.messages.types import ChannelError, header_ns

EXCITATION_TYPE = "sensor_msgs/msg/JointState"


def read_excitation(message: Any) -> tuple[int, tuple[float, ...]]:
    """Return stamp, ns, and de, dr, da, dth; 0 for those that the message does not name.

    Raises
    ------
    ChannelError
        If it names something else, holds no value for a name, or one that is not finite.
    """
    names, positions = list(message.name), list(message.position)
    unknown = [name for name in names if name not in INPUTS]
    if unknown or len(names) != len(positions) or not names:
        raise ChannelError(
            f"names {names} with {len(positions)} positions: some of {', '.join(INPUTS)} are "
            "wanted, each with a position"
        )
    if not all(map(math.isfinite, positions)):
        raise ChannelError(f"position is {positions}: finite numbers are needed", not_finite=True)
    by_name = dict(zip(names, positions, strict=True))
    return header_ns(message), tuple(float(by_name.get(name, 0.0)) for name in INPUTS)
