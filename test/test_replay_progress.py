# SPDX-License-Identifier: Apache-2.0
"""The progress bar of `replay`: on a terminal, where tqdm is there, and nowhere else."""

import itertools
import math
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from excerpts import excerpt
from programs import Capture, Terminal

from uav_ident_ros.offline import NOT_USABLE, USABLE, job


def on_a_terminal(arguments: list[str]) -> tuple[int, str]:
    """Run `replay` with a terminal as its error stream; return status and what was shown."""
    command = [sys.executable, "-m", "uav_ident_ros.offline", *arguments]
    nowhere = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    with closing(Terminal(command, 100, **nowhere)) as terminal:
        terminal.read_until("to the end of what is shown", math.inf)
        return terminal.process.wait(), terminal.received


def test_one_bag_shows_every_phase_and_the_time_left(tmp_path: Path) -> None:
    bag = excerpt(tmp_path / "bag", 8.0)
    status, shown = on_a_terminal([str(bag), "--output", str(tmp_path / "out")])
    assert status in (USABLE, NOT_USABLE), shown
    given = re.findall(r"(\w+) +(\d+)%\|.*?\| [\d:]+<[\d:?]+", shown)
    assert list(dict.fromkeys(phase for phase, _ in given)) == list(job.BEGINS)
    shares = [int(share) for _, share in given]
    assert shares == sorted(shares)
    assert shares[-1] == 95
    assert len(set(shares)) > 20


def test_many_bags_show_one_bar(tmp_path: Path) -> None:
    bag, output = str(excerpt(tmp_path / "bag", 4.0)), tmp_path / "out"
    status, shown = on_a_terminal([bag, bag, "--output", str(output), "--jobs", "2"])
    assert status in (USABLE, NOT_USABLE), shown
    shares = [int(share) for share in re.findall(r"(\d+)%", shown)]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 100)
    assert "reading" not in shown
    folders = sorted(path.name for path in output.iterdir() if path.is_dir())
    assert len(folders) == 2 and folders[1] == f"{folders[0]}_2"


def test_without_a_terminal_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    now = itertools.count(0.0, 10.0)  # every look at the clock is ten seconds later
    monkeypatch.setattr("tqdm.std.time", lambda: next(now))
    with job.Progress() as shown:
        shown.enter("reading")
        assert list(shown.messages(range(8), 8)) == list(range(8))  # type: ignore[arg-type]
    shares = [int(share) for share in re.findall(r"reading +(\d+)%", capsys.readouterr().err)]
    assert shares == sorted(shares)
    assert 2 <= len(shares) < 8
