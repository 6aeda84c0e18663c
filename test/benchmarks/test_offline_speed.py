# SPDX-License-Identifier: Apache-2.0
"""The cost of `replay`, in parts that add up; and what a gyro sample passes on its way."""

from __future__ import annotations

import re

import offline_speed
import pytest
import sample_walk
from programs import Capture


def test_table(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
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


def test_the_walk_of_a_sample_leads_through_the_parts_in_their_order(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(sample_walk, "LEARNING", 1.0)
    sample_walk.main([])
    *files, last = capsys.readouterr().out.splitlines()
    counts = [int(line.split()[0]) for line in files]
    assert last.startswith(f"{len(files)} files, {sum(counts)} functions ")
    names = [line.split()[1].removeprefix("identification/") for line in files]
    parts = ["identifier.py", "intake.py", "sampling.py", "regression.py", "supervision.py"]
    assert set(parts) <= set(names) and names[0] == parts[0]
