# SPDX-License-Identifier: Apache-2.0
"""Stamps that no message can carry are dropped, and what follows them is still published."""

from __future__ import annotations

import pytest

from uav_ident_ros.identification.drops import LATEST_STAMP, Drop
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings

INTERVAL = 5_000_000


@pytest.mark.parametrize("t_ns", [LATEST_STAMP + 1, 2**63, 2**80])
def test_a_stamp_beyond_the_end_of_time_is_dropped(t_ns: int) -> None:
    identifier = OnlineIdentifier(Settings())
    assert identifier.add_rates(t_ns, (0.0, 0.0, 0.0)) is Drop.BEYOND_STAMP
    assert identifier.add_actuators(t_ns, (0.0, 0.0, 0.0, 0.0)) is Drop.BEYOND_STAMP
    assert identifier.add_airspeed(t_ns, 20.0) is Drop.BEYOND_STAMP
    assert identifier.add_armed(t_ns, True) is Drop.BEYOND_STAMP


def test_ticks_end_with_the_last_stamp() -> None:
    identifier = OnlineIdentifier(Settings())
    start = LATEST_STAMP - 1_000_000_000
    ticks = []
    for k in range(400):
        identifier.add_rates(start + k * INTERVAL, (0.0, 0.01 * (k % 7), 0.0))
        identifier.add_actuators(start + k * INTERVAL, (0.0, 0.0, 0.0, 0.0))
        while (due := identifier.due()) is not None:
            estimate = identifier.update(due)
            assert estimate is not None
            ticks.append(estimate.t_ns)
    assert ticks
    assert max(ticks) <= LATEST_STAMP
