# SPDX-License-Identifier: Apache-2.0
"""Every printed command of the documentation runs, except for those of ROS or a cluster.

The flights are short, in a folder with the names of the pages. Run by .ci/run:

    scripts/test -m campaign test/test_commands.py
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from excerpts import BAGS, excerpt
from good_logs import ulog
from repository import ROOT
from test_docs import DOCS, README, code_blocks, page_id, text_of

from uav_ident_ros.commandline import NOT_USABLE

SECONDS = 12.0
"""Length of the flights, s: the models may be unusable."""

PROGRAMS = ("fleet", "import_log", "replay", "simulate")
RUNNABLE = re.compile(rf"\.venv/bin/(?:{'|'.join(PROGRAMS)}) ")
ELSEWHERE = re.compile(r"^(?:ros2|scripts/|\.venv/bin/monitor) |--scheduler", re.MULTILINE)


def runnable(page: Path) -> list[str]:
    """Return the blocks of a page to be run, without those of other programs."""
    blocks = code_blocks(text_of(page))
    return [b for b in blocks if RUNNABLE.search(b) and not ELSEWHERE.search(b)]


PAGES = [page for page in (README, *DOCS) if runnable(page)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Create the files of the commands: bags, a folder of flights, a log, parameters."""
    for bag in (path for path in BAGS.iterdir() if (path / "metadata.yaml").exists()):
        excerpt(tmp_path / "bags" / bag.name, SECONDS, bag.name)
        shutil.copy(bag / "identifier.yaml", tmp_path / "bags" / bag.name)
    shutil.copytree(tmp_path / "bags" / "multisine", tmp_path / "flights" / "first")
    shutil.copytree(tmp_path / "bags" / "multisine", tmp_path / "BAG")
    (tmp_path / "vehicle.yaml").symlink_to(BAGS / "multisine" / "identifier.yaml")
    (tmp_path / "config").symlink_to(ROOT / "config")
    ulog(tmp_path).rename(tmp_path / "flight.ulg")
    (tmp_path / "output").mkdir()
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in PROGRAMS:
        real = Path(sys.executable).parent / name
        program = programs / name
        program.write_text(f'#!/bin/sh\n"{real}" "$@"\ntest $? -le {NOT_USABLE}\n')
        program.chmod(0o755)
    return tmp_path


@pytest.mark.campaign
@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_the_commands_of_a_page_run(page: Path, folder: Path) -> None:
    script = re.sub(r"(?<=--duration )\S+", f"{SECONDS:g}", "\n".join(runnable(page)))
    done = subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", script], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
