# SPDX-License-Identifier: Apache-2.0
"""What is wrong with the stamps of a stream, in the words of an import."""

import numpy as np
import pytest

from uav_ident_ros.import_logs.stamps import NS_PER_S, describe, doubts

STAMPS = 4_000_000 * np.arange(500) + 20 * NS_PER_S


def test_gaps_are_told_by_their_number_and_length() -> None:
    t_ns = np.r_[STAMPS[:200], STAMPS[200:300] + 60 * NS_PER_S, STAMPS[300:] + 61 * NS_PER_S]
    said = "2 gaps of more than 0.02 s, together 61 s, the longest 60 s at 20.80 s"
    assert doubts(t_ns) == [said]
    assert describe(t_ns).endswith("at 250 Hz")


@pytest.mark.parametrize("t_ns", [STAMPS, STAMPS[:1], STAMPS[:0]])
def test_streams_without_a_gap_have_none(t_ns: np.ndarray) -> None:
    assert doubts(t_ns) == []


def test_steps_back_and_repetitions_are_counted() -> None:
    assert doubts(np.r_[STAMPS, STAMPS[-1], STAMPS[0]]) == [
        "1 stamps are earlier than the one before", "1 stamps repeat the one before"
    ]  # fmt: skip
