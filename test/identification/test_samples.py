# SPDX-License-Identifier: Apache-2.0
"""Samples are used in the order of their stamps, whatever the order they came in."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uav_ident_ros.identification.samples import SampleBuffer


def filled(*stamps: int) -> SampleBuffer:
    buffer = SampleBuffer(1)
    for t in stamps:
        buffer.append(t, (float(t),))
    return buffer


def test_of_samples_with_one_stamp_the_first_to_arrive_counts() -> None:
    buffer = filled(20)
    for value in (1.0, 2.0, 3.0):
        buffer.append(10, (value,))
    assert buffer.merge(100) == 2
    assert buffer.t.tolist() == [10, 20]
    assert buffer.v[0, 0] == 1.0


@given(st.permutations(range(12)), st.lists(st.integers(0, 12), max_size=4))
def test_whatever_the_order_of_arrival_samples_wait_for_a_tick_at_or_after_their_stamp(
    order: list[int], ticks: list[int]
) -> None:
    buffer = filled(*order)
    for tick in [*sorted(ticks), 12]:
        buffer.merge(tick)
        used = list(range(min(tick, 11) + 1))
        assert buffer.t.tolist() == buffer.v[:, 0].tolist() == used


def test_trim_keeps_the_sample_that_still_applies() -> None:
    buffer = filled(10, 20, 30)
    buffer.merge(30)
    buffer.trim(25)
    assert buffer.t.tolist() == [20, 30]
    buffer.trim(20)
    assert buffer.t.tolist() == [20, 30]
    buffer.trim(5)
    assert buffer.t.tolist() == [20, 30]


def test_interpolation_is_exact_at_the_samples_and_straight_between() -> None:
    buffer = filled(10, 20, 40)
    buffer.merge(40)
    requested = np.array([10, 15, 20, 35, 40])
    assert buffer.interpolate(requested)[:, 0].tolist() == [10.0, 15.0, 20.0, 35.0, 40.0]


def test_waiting_samples_are_dropped_once_they_are_old() -> None:
    buffer = SampleBuffer(1)
    for t in range(0, 10_000):
        buffer.append(t, (0.0,))
        buffer.forget_waiting(t, 100)
    buffer.merge(10_000)
    assert 100 <= len(buffer.t) <= 202
    assert buffer.t[-1] == 9_999
