# SPDX-License-Identifier: Apache-2.0
"""What the repository says of itself."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any
from unittest import mock

import setuptools

ROOT = Path(__file__).resolve().parents[1]


def setup_arguments() -> dict[str, Any]:
    """Run setup.py with `setuptools.setup` replaced by a recorder; return what it was given."""
    recorded: dict[str, Any] = {}
    with mock.patch.object(setuptools, "setup", lambda **arguments: recorded.update(arguments)):
        runpy.run_path(str(ROOT / "setup.py"))
    return recorded


def console_scripts() -> dict[str, str]:
    """Executables and what they call."""
    lines = setup_arguments()["entry_points"]["console_scripts"]
    return dict(re.split(r"\s*=\s*", line, maxsplit=1) for line in lines)
