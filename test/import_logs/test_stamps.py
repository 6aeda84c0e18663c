# SPDX-License-Identifier: Apache-2.0
"""What the stamps of streams tell: which no clock gave, and where nothing was logged."""

import numpy as np
import pytest

from uav_ident_ros.import_logs.stamps import (
    NS_PER_S,
    describe,
    doubts,
    gaps_in_words,
    pauses,
    plausible,
)

STAMPS = 4_000_000 * np.arange(500) + 20 * NS_PER_S


@pytest.mark.parametrize("places", [[0], [1], [250], [250, 251], [497], [3, 100, 400]])
@pytest.mark.parametrize("value", [0, 5 * NS_PER_S, 9000 * NS_PER_S, 2**31 * NS_PER_S, -1])
def test_single_damaged_stamps_are_found(places: list[int], value: int) -> None:
    t_ns = STAMPS.copy()
    t_ns[places] = value
    early = value < STAMPS[0] and places == [0]  # as of a topic that was published long before
    expected = np.arange(len(t_ns)) if early and value >= 0 else np.delete(np.arange(500), places)
    np.testing.assert_array_equal(np.flatnonzero(plausible(t_ns)), expected)


@pytest.mark.parametrize(
    "t_ns",
    [
        STAMPS,
        STAMPS[:3],
        np.array([1, 200, 201, 202, 900, 901, 2000]) * NS_PER_S,  # changes of a state
        np.array([20.2, 25.83, 25.836, 26.0, 26.2, 26.4, 31.0]) * NS_PER_S,
        np.r_[STAMPS, STAMPS[-1] + 60 * NS_PER_S],  # a straggler
        np.r_[STAMPS[:200], STAMPS[300:] + 60 * NS_PER_S],  # a gap
        np.r_[STAMPS + 60 * NS_PER_S, STAMPS],  # a restart of the autopilot
        STAMPS + np.random.default_rng(1).integers(-(10**8), 10**8, len(STAMPS)),  # disorder
    ],
)
def test_gaps_stragglers_and_restarts_are_no_damage(t_ns: np.ndarray) -> None:
    assert plausible(np.asarray(t_ns, dtype=np.int64)).all()


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
