# SPDX-License-Identifier: Apache-2.0
"""The benchmark of `replay`: its parts add up, and it replays what the command replays."""

from __future__ import annotations

import re

import offline_speed
import pytest


def test_table(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["offline_speed.py", "--minutes", "0.2", "--rounds", "1"])
    offline_speed.main()
    printed = capsys.readouterr().out
    assert "12 s of flight, 3002 messages, 240 ticks of instrumental_variable" in printed
    rows = {
        name: [float(number) for number in re.findall(r"[\d.]+", numbers)]
        for name, numbers in re.findall(r"^ *([a-z, ]+?)  +(.*)$", printed, re.MULTILINE)
    }
    parts = [rows[name] for name in ("reading", "ticks", "scoring", "advice", "writing")]
    assert sum(part[0] for part in parts) == pytest.approx(rows["replay"][0], abs=0.003)
    assert sum(part[1] for part in parts) == pytest.approx(100.0, abs=3.0)
    assert all(part[0] > 0.0 for part in parts)
    assert rows["rosbags, raw"][1] == 1.0
