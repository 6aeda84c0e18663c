# SPDX-License-Identifier: Apache-2.0
"""The demonstration, on a short flight and off a terminal."""

import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from excerpts import BAGS, PARAMETERS, excerpt
from programs import Capture, python, refusal
from repository import ROOT

from uav_ident_ros.commandline import INTERRUPTED
from uav_ident_ros.demo import main

PNG = b"\x89PNG"


def test_the_demo_prints_the_monitor_view_and_the_results_of_a_replay(tmp_path: Path) -> None:
    bag = excerpt(tmp_path / "short", 6.0)
    shutil.copy(PARAMETERS, bag)
    options = ("--speed", "4", "--output", str(tmp_path))
    run = python("-m", "uav_ident_ros", "demo", str(bag), *options, timeout=300.0)
    assert run.returncode == 0, run.stderr
    fits = re.findall(
        r"^free prediction, 1 s(.*)\nholding the rates for 1 s(.*)$", run.stdout, re.MULTILINE
    )
    model, hold = ([float(value) for value in line.split()] for line in fits[0])
    assert all(m > 50.0 > h for m, h in zip(model, hold, strict=True))
    folder = tmp_path / "demo_short"
    assert (folder / "replay.png").read_bytes().startswith(PNG)
    assert (folder / "report.html").is_file()
    # the monitor's view of the live node
    assert re.search(r"^/identifier  (learning|converged)  ", run.stdout, re.MULTILINE)


def test_ctrl_c_ends_the_demo_and_its_node_during_playback(tmp_path: Path) -> None:
    options = ["--speed", "1", "--output", str(tmp_path)]
    command = [sys.executable, "-m", "uav_ident_ros", "demo", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        assert any("/identifier" in line for line in demo.stdout)  # the view of the node
        demo.send_signal(signal.SIGINT)
        assert demo.wait(30.0) == INTERRUPTED
    assert "Traceback" not in (tmp_path / "demo_c172p" / "node.log").read_text()


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (("none",), "bag 'none' does not exist"),
        (("--speed", "9"), "'9': 0.1 to 5 times real time"),
        (("--speed", "fast"), "'fast': 0.1 to 5 times real time"),
        ((str(ROOT / "bags" / "multisine"), "--params-file", "none.yaml"), "there is no such file"),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    arguments: tuple[str, ...], printed: str, tmp_path: Path, capsys: Capture
) -> None:
    assert printed in refusal(main, [*arguments, "--output", str(tmp_path)], capsys)


def test_an_output_that_cannot_be_written_is_refused(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").touch()
    bag, output = str(BAGS / "multisine"), tmp_path / "file" / "results"
    line = refusal(main, [bag, "--output", str(output)], capsys)
    assert line == f"demo: cannot write into '{output / 'demo_multisine'}': Not a directory"
