# SPDX-License-Identifier: Apache-2.0
"""Hazards of the closed loop: the altered messages and the list of lost aircraft."""

import loop_hazards
import numpy as np
import pytest
from plants import START, coefficients

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("hazard", "t", "stamps", "share"),
    [
        ("none", 20.0, [0], 1.0),
        ("stamps 5 s ahead", 14.0, [0], 1.0),
        ("stamps 5 s ahead", 20.0, [5], 1.0),
        ("another publisher, effects threefold", 20.0, [0, 0], 3.0),
        ("silent for 2 s, elevator halved in it", 19.0, [], 1.0),
    ],
)
def test_each_hazard_alters_stamps_count_and_effects_of_messages(
    hazard: str, t: float, stamps: list[int], share: float
) -> None:
    sent = coefficients()
    found = loop_hazards.HAZARDS[hazard].messages(t, sent, RNG)
    assert [(one.t_ns - START) // 10**9 for one in found] == stamps
    if found:
        assert found[-1].values[0, 10] == pytest.approx(share * sent.values[0, 10])


def test_aircraft_lost_where_the_fixed_loop_survives_are_listed() -> None:
    flown = {"lost": None, "errors": [[1.0, 2.0, 3.0]] * 3, "sources": [["nominal"]] * 3}
    gone = {**flown, "lost": 12.3, "errors": []}
    found = {"fog: kite": (gone, flown), "none: kite": (flown, flown), "rain: kite": (gone, gone)}
    *table, last = loop_hazards.lines(found)
    assert last == "lost where the fixed loop survives: fog: kite"
    assert "**lost** at 12 s" in table[2] and "1.0 / 2.0 / 3.0" in table[3]
