# SPDX-License-Identifier: Apache-2.0
"""Notices are repeated often enough to be seen, and never flood."""

import pytest
import rclpy

from uav_ident_ros.node.notices import (
    REPEAT_AFTER,
    Guard,
    Throttle,
    without_numbers,
    without_sources,
)


def test_a_repeated_notice_is_counted_and_repeated_later_and_delays_no_other() -> None:
    now, printed = [0.0], []
    throttle = Throttle(printed.append, clock=lambda: now[0])
    for _ in range(10):
        throttle.notice(("/imu/data", "not finite"), "bad")
    throttle.notice(("/actuators", "not finite"), "bad too")
    now[0] = REPEAT_AFTER
    throttle.notice(("/imu/data", "not finite"), "bad")
    assert printed == ["bad", "bad too", "bad (9 more like it before)"]


def test_a_state_with_other_numbers_is_the_same_and_ros_sources_are_left_out() -> None:
    assert without_numbers("paused: fit 12.5 %") == without_numbers("paused: fit 9 %")
    assert without_numbers("paused: fit 9 %") != without_numbers("paused")
    assert without_sources("it failed, at /project/src/a.c:12, at b.c:3") == "it failed"


def test_an_unexpected_error_is_logged_and_survived() -> None:
    printed: list[str] = []
    guard = Guard(Throttle(printed.append, clock=lambda: 0.0))

    def on_timer(number: float) -> float:
        return 1.0 / number

    guarded = guard(on_timer, lambda number: -1.0)
    rclpy.init()
    try:
        assert guarded(2.0) == 0.5
        assert guard.problem == ""
        assert [guarded(0.0), guarded(0.0)] == [-1.0, -1.0]
    finally:
        rclpy.shutdown()
    assert guard.count == 2
    assert (
        guard.problem == "internal error in 'on_timer': ZeroDivisionError: float division by zero"
    )
    assert len(printed) == 1
    assert "Traceback" in printed[0]
    with pytest.raises(ZeroDivisionError):
        guarded(0.0)  # at the end of the program
