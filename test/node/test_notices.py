# SPDX-License-Identifier: Apache-2.0
"""What is said often enough to be seen, and never a flood."""

from __future__ import annotations

from uav_ident_ros.notices import OnChange, Throttle, without_sources


def test_repeated_notice_is_counted_and_said_again_later() -> None:
    now, said = [0.0], []
    throttle = Throttle(said.append, repeat_after=5.0, clock=lambda: now[0])
    for _ in range(10):
        throttle.notice(("/imu/data", "not finite"), lambda: "bad")
    assert said == ["bad"]
    now[0] = 5.0
    throttle.notice(("/imu/data", "not finite"), lambda: "bad")
    assert said == ["bad", "bad (9 more like it before)"]


def test_other_notices_are_not_held_back() -> None:
    said: list[str] = []
    throttle = Throttle(said.append, clock=lambda: 0.0)
    throttle.notice(("/imu/data", "late"), lambda: "late")
    throttle.notice(("/actuators", "late"), lambda: "late too")
    assert said == ["late", "late too"]


def test_state_is_said_once_per_change() -> None:
    log = OnChange()
    lines = ("learning", "learning", "paused: fit 12.5 %", "paused: fit 9 %", "paused", "learning")
    assert [log.changed(line) for line in lines] == [True, False, True, False, True, True]


def test_ros_sources_are_left_out() -> None:
    assert without_sources("it failed, at /project/src/a.c:12, at b.c:3") == "it failed"
