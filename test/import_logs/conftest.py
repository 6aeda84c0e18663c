# SPDX-License-Identifier: Apache-2.0
"""Fixture for logs imported by the command."""

from pathlib import Path

import pytest
from imported import Importer
from programs import Capture


@pytest.fixture
def importer(tmp_path: Path, capsys: Capture) -> Importer:
    """Return an importer of logs into bags of one folder."""
    return Importer(tmp_path, capsys)
