# SPDX-License-Identifier: Apache-2.0
"""The demonstration, on a short flight and off a terminal."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

from node_process import ROOT
from recordings import recording, write_bag

PNG = b"\x89PNG"


def demo(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "uav_ident_ros.demo", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )


def test_it_shows_a_flight_as_the_monitor_does_and_reports_as_replay_does(tmp_path: Path) -> None:
    flight = recording("multisine", 10.0)
    bag = write_bag(flight, tmp_path / "short")
    shutil.copy(flight.parameter_file, bag)
    run = demo(str(bag), "--speed", "4", "--output", str(tmp_path))
    assert run.returncode == 0, run.stderr
    fits = re.findall(
        r"^identified model, 1 s(.*)\n +holding the rates(.*)$", run.stdout, re.MULTILINE
    )
    model, hold = ([float(value) for value in line.split()] for line in fits[0])
    assert all(m > 50.0 > h for m, h in zip(model, hold, strict=True))
    folder = tmp_path / "demo_short"
    assert (folder / "replay.png").read_bytes().startswith(PNG)
    assert (folder / "report.html").is_file()
    # the monitor's view of the live node
    assert re.search(r"^/identifier  (learning|converged)  ", run.stdout, re.MULTILINE)


def test_wrong_input_is_refused_in_one_line(tmp_path: Path) -> None:
    for arguments, said in (
        (("none",), "bag 'none' does not exist"),
        (("--speed", "9"), "0.1 to 5"),
        ((str(ROOT / "bags" / "multisine"), "--params-file", "none.yaml"), "does not exist"),
    ):
        run = demo(*arguments, "--output", str(tmp_path))
        assert run.returncode == 2
        assert said in run.stderr
        assert run.stderr.count("\n") == 1
