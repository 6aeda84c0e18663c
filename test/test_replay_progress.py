# SPDX-License-Identifier: Apache-2.0
"""The progress bar of `replay`: on a terminal, where tqdm is there, and nowhere else."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from uav_ident_ros.offline import progress

ROOT = Path(__file__).parent.parent
BAG = ROOT / "bags" / "pulses"


def on_a_terminal(arguments: list[str]) -> tuple[int, str]:
    """Run `replay` with a terminal as its error stream; return status and what was shown."""
    shown, stream = pty.openpty()
    termios.tcsetwinsize(stream, (24, 100))  # of no columns nothing is shown
    process = subprocess.Popen(
        [sys.executable, "-m", "uav_ident_ros.offline", *arguments],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=stream,
    )  # fmt: skip
    os.close(stream)
    text = b""
    while True:
        try:
            part = os.read(shown, 4096)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        text += part
    os.close(shown)
    return process.wait(), text.decode()


def test_one_bag_shows_how_many_messages_have_passed(tmp_path: Path) -> None:
    status, shown = on_a_terminal([str(BAG), "--output", str(tmp_path)])
    assert status == 0, shown
    assert "messages" in shown
    assert "0%" in shown


def test_many_bags_show_one_bar(tmp_path: Path) -> None:
    status, shown = on_a_terminal([str(BAG), str(BAG), "--output", str(tmp_path), "--jobs", "2"])
    assert status == 0, shown
    shares = [int(share) for share in re.findall(r"(\d+)%", shown)]
    assert shares == sorted(shares)
    assert shares[0] == 0
    assert shares[-1] > 80
    assert "messages" not in shown
    assert sorted(os.listdir(tmp_path)) == ["bags_pulses", "bags_pulses_2"]


def test_without_a_terminal_or_tqdm_there_is_no_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = [1, 2, 3]
    assert progress.bar(total=3) is None  # pytest's error stream is none
    assert progress.of_messages(messages, 3) is messages
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert progress.bar(total=3) is None
