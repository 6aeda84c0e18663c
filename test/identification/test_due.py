# SPDX-License-Identifier: Apache-2.0
"""When a tick is computed: as soon as nothing that belongs to it can come any more."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings

MS = 1_000_000
START = 1_700_000_000_000 * MS
WAIT = 50


def messages(seconds: float) -> Iterator[tuple[int, str]]:
    """Stamps (ms) and streams in the order of their arrival: 200 Hz, 50 Hz off the ticks."""
    for t in range(0, round(1e3 * seconds), 5):
        yield t, "rates"
        if t % 20 == 5:
            yield t, "actuators"


def lags(identifier: OnlineIdentifier, arriving: Iterator[tuple[int, str]]) -> dict[int, int]:
    """Time that the newest Imu stamp had passed each tick (ms) when that was due, ms."""
    rng, newest, found = np.random.default_rng(0), 0, {}
    for t, stream in arriving:
        if stream == "rates":
            newest = max(newest, t)
            identifier.add_rates(START + t * MS, rng.normal(size=3), (0.0, 0.0, 9.8))
        elif stream == "actuators":
            identifier.add_actuators(START + t * MS, rng.normal(size=4))
        else:
            identifier.add_armed(START + t * MS, True)
        while (due := identifier.due()) is not None:
            identifier.update(due)
            found[(due - START) // MS] = newest - (due - START) // MS
    return found


def test_a_tick_waits_for_nothing_once_all_streams_proved_orderly() -> None:
    found = lags(OnlineIdentifier(Settings()), messages(8.0))
    assert {lag for tick, lag in found.items() if tick < 5000} == {WAIT}
    late = [lag for tick, lag in found.items() if tick > 5050]
    assert max(late) <= 20  # an interval of the actuators
    assert np.median(late) < 16


@pytest.mark.parametrize("stream", ["rates", "actuators"])
def test_a_stream_out_of_order_is_waited_for_ever_after(stream: str) -> None:
    def disturbed() -> Iterator[tuple[int, str]]:
        for t, name in messages(13.0):
            yield t, name
            if t == 1000 and name == "rates":
                yield (984 if stream == "actuators" else 992), stream

    identifier = OnlineIdentifier(Settings())
    assert set(lags(identifier, disturbed()).values()) == {WAIT}
    assert not sum((sum(drops.values()) for drops in identifier.drops.values()), 0)


def test_a_stream_that_is_seldom_sent_is_waited_for() -> None:
    def with_armed() -> Iterator[tuple[int, str]]:
        for t, name in messages(8.0):
            yield t, name
            if t % 1000 == 20 and name == "rates":
                yield t, "armed"

    settings = Settings.from_values({"armed.type": "std_msgs/msg/Bool"})
    found = lags(OnlineIdentifier(settings), with_armed())
    assert [lag for tick, lag in found.items() if tick > 5100 and tick % 1000 != 0].count(WAIT) > 40
