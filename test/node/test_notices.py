# SPDX-License-Identifier: Apache-2.0
"""Notices are repeated often enough to be seen, and never flood; a node notices its own delays."""

import time

import pytest
import rclpy

from uav_ident_ros.node.diagnostics import TickMeter
from uav_ident_ros.node.notices import Guard, OnChange, Throttle, without_sources


def test_a_repeated_notice_is_counted_and_repeated_later_and_delays_no_other() -> None:
    now, printed = [0.0], []
    throttle = Throttle(printed.append, repeat_after=5.0, clock=lambda: now[0])
    for _ in range(10):
        throttle.notice(("/imu/data", "not finite"), lambda: "bad")
    throttle.notice(("/actuators", "not finite"), lambda: "bad too")
    now[0] = 5.0
    throttle.notice(("/imu/data", "not finite"), lambda: "bad")
    assert printed == ["bad", "bad too", "bad (9 more like it before)"]


def test_a_state_is_logged_once_per_change() -> None:
    log = OnChange()
    lines = ("learning", "learning", "paused: fit 12.5 %", "paused: fit 9 %", "paused", "learning")
    assert [log.changed(line) for line in lines] == [True, False, True, False, True, True]


def test_ros_sources_are_left_out() -> None:
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


def test_a_node_that_was_held_up_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    meter = TickMeter(0.05)
    for interval in (0.05, 1.4, 0.05):
        meter.called()
        assert meter.held_up() == pytest.approx(0.0 if now < 101.0 else 1.4)
        now += interval
    now += 10.0
    assert meter.held_up() == 0.0
