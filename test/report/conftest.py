# SPDX-License-Identifier: Apache-2.0
"""One report of a committed bag, for all tests of the report."""

from __future__ import annotations

from pathlib import Path

import pytest
from excerpts import BAGS
from once import made_once

from uav_ident_ros.offline import main


@pytest.fixture(scope="session")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a replay with a report."""

    def replay(folder: Path) -> None:
        bag = BAGS / "c172p"
        parameters = ["--params-file", str(bag / "identifier.yaml")]
        assert main([str(bag), *parameters, "--output", str(folder), "--report"]) == 0

    return made_once(tmp_path_factory, "report", replay)
