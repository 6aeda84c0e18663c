# SPDX-License-Identifier: Apache-2.0
"""Logs imported by the command, as a user does."""

from pathlib import Path

import pytest
from imported import Importer
from programs import Capture


@pytest.fixture
def importer(tmp_path: Path, capsys: Capture) -> Importer:
    """Imports logs into bags of one folder."""
    return Importer(tmp_path, capsys)
