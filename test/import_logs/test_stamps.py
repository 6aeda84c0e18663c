# SPDX-License-Identifier: Apache-2.0
"""Where nothing was logged, in the words of an import."""

import numpy as np
import pytest

from uav_ident_ros.import_logs.stamps import (
    NS_PER_S,
    describe,
    doubts,
    gaps_in_words,
    pauses,
)

STAMPS = 4_000_000 * np.arange(500) + 20 * NS_PER_S


def test_a_gap_of_all_streams_is_said_once() -> None:
    """The slower one sees it a little longer; a gap of its own stays its own."""
    fast = np.r_[STAMPS[:200], STAMPS[200:] + 60 * NS_PER_S]
    slow = np.delete(fast[::10], slice(30, 35))
    paused, limit_ns = pauses([fast, slow])
    (said,) = gaps_in_words(paused, limit_ns)
    assert said == "1 gap of more than 0.02 s, together 60 s, the longest 60 s at 20.80 s"
    assert doubts(fast, paused) == []
    (own,) = doubts(slow, paused)
    assert own.startswith("1 gap of more than 0.12 s, together 0.24 s")
    assert len(doubts(fast)) == 1
    assert describe(fast).endswith("at 250 Hz")


@pytest.mark.parametrize("streams", [[], [STAMPS], [STAMPS, STAMPS[:1]], [STAMPS, STAMPS[::-1]]])
def test_streams_without_a_gap_have_none_in_common(streams: list[np.ndarray]) -> None:
    assert not len(pauses(streams)[0])
