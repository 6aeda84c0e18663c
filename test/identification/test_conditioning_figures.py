# SPDX-License-Identifier: Apache-2.0
"""The figures asked of the conditioning, as ``python benchmarks/conditioning.py`` prints them."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"

pytestmark = pytest.mark.campaign


@pytest.mark.parametrize("section", ["invariance", "exact", "channels", "aircraft", "delay"])
def test_every_figure_asked_is_met(
    section: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "campaign" not in request.config.option.markexpr:
        pytest.skip("takes minutes: run with -m campaign")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    conditioning = importlib.import_module("conditioning")
    rows = list(conditioning.SECTIONS[section]())
    assert any(row.wanted for row in rows)
    short = [conditioning.line(row) for row in rows if not row.met]
    assert not short, "\n".join(short)
