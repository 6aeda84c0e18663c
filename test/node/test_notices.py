# SPDX-License-Identifier: Apache-2.0
"""Throttled notices: repetition after a pause, and no flood."""

import pytest
import rclpy

from uav_ident_ros.node.notices import (
    REPEAT_AFTER,
    Guard,
    Throttle,
    without_numbers,
    without_sources,
)


def test_repeated_notices_are_counted_and_throttled_by_kind() -> None:
    now, printed = [0.0], list[str]()
    throttle = Throttle(printed.append, clock=lambda: now[0])
    for _ in range(10):
        throttle.notice(("/imu/data", "not finite"), "bad")
    throttle.notice(("/actuators", "not finite"), "bad too")
    now[0] = REPEAT_AFTER
    throttle.notice(("/imu/data", "not finite"), "bad")
    assert printed == ["bad", "bad too", "bad (9 more like it before)"]


def test_notices_are_compared_without_numbers_and_ros_source_lines() -> None:
    assert without_numbers("paused: fit 12.5 %") == without_numbers("paused: fit 9 %")
    assert without_numbers("paused: fit 9 %") != without_numbers("paused")
    assert without_numbers("qdot has 0.55 times") != without_numbers("rdot has 0.55 times")
    assert without_sources("it failed, at /project/src/a.c:12, at b.c:3") == "it failed"


def test_an_unexpected_error_is_logged_once_and_followed_by_the_recovery() -> None:
    printed: list[str] = []
    guard = Guard(Throttle(printed.append, clock=lambda: 0.0))

    @guard("on_timer", lambda: printed.append("recovered"))
    def guarded(number: float) -> float:
        return 1.0 / number

    rclpy.init()
    try:
        assert guarded(2.0) == 0.5
        assert guard.problem == ""
        assert [guarded(0.0), guarded(0.0)] == [None, None]
    finally:
        rclpy.shutdown()
    assert guard.count == 2
    assert (
        guard.problem == "internal error in 'on_timer': ZeroDivisionError: float division by zero"
    )
    assert printed[1:] == ["recovered", "recovered"]
    assert "Traceback" in printed[0]
    with pytest.raises(ZeroDivisionError):
        guarded(0.0)  # at the end of the program
