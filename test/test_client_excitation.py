# SPDX-License-Identifier: Apache-2.0
"""What a controller adds: what it is asked to, bounded, and no longer than it is asked to."""

import math

import pytest

from uav_ident_ros.client import Excitation
from uav_ident_ros.identification.settings import EXCITATION_TIMEOUT
from uav_ident_ros.identification.structure import INPUTS

MS = 1_000_000
NAMES = list(INPUTS)


@pytest.fixture
def excitation() -> Excitation:
    return Excitation(limit=[0.1, 0.1, 0.1, 0.0])


def test_a_value_counts_from_its_stamp_until_the_next_or_the_timeout(
    excitation: Excitation,
) -> None:
    assert not excitation.at(10**9).any(), "nothing is asked for yet"
    excitation.add(100 * MS, NAMES, [0.01, 0.0, 0.0, 0.0])
    excitation.add(150 * MS, NAMES, [0.02, 0.0, 0.0, 0.0])
    wanted = {99: 0.0, 100: 0.01, 149: 0.01, 150: 0.02, 200: 0.02}
    assert {t: excitation.at(t * MS)[0] for t in wanted} == wanted
    last = 150 * MS + round(EXCITATION_TIMEOUT * 1e9)
    assert excitation.at(last).any()
    assert not excitation.at(last + 1).any()


def test_an_abort_calls_off_what_was_asked_for_ahead(excitation: Excitation) -> None:
    for k in range(5):
        excitation.add((100 + 50 * k) * MS, NAMES, [0.05] * 4)
    excitation.add(170 * MS, NAMES, [0.0] * 4)
    assert excitation.at(169 * MS).any()
    assert not any(excitation.at(t * MS).any() for t in range(170, 600))


def test_it_never_adds_more_than_its_limit_and_nothing_to_inputs_that_are_not_named(
    excitation: Excitation,
) -> None:
    excitation.add(0, NAMES, [5.0, -5.0, 0.05, 5.0])
    assert excitation.at(0).tolist() == [0.1, -0.1, 0.05, 0.0]
    excitation.add(1, ["da", "de"], [0.02, 0.03])
    assert excitation.at(1).tolist() == [0.03, 0.0, 0.02, 0.0]


def test_a_message_that_cannot_be_right_asks_for_nothing(excitation: Excitation) -> None:
    for k, (names, values) in enumerate(
        ((["de", "flap"], [0.05, 0.05]), (["de"], [math.nan]), (["de"], [math.inf]),
         (["de", "da"], [0.05]))
    ):  # fmt: skip
        excitation.add((100 + 20 * k) * MS, NAMES, [0.05] * 4)
        excitation.add((110 + 20 * k) * MS, names, values)
        assert not excitation.at((115 + 20 * k) * MS).any(), names
