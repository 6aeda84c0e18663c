# SPDX-License-Identifier: Apache-2.0
"""A few of the mutated files of benchmarks/fuzz.py: read, or refused in one line."""

from pathlib import Path

import fuzz
import pytest

COUNTS = {"ulg": 20, "bin": 20, "csv": 20, "bbl": 8, "mcap none": 8, "mcap lz4": 8, "mcap zstd": 8}
"""Files of each kind; `benchmarks/fuzz.py` takes thousands."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return fuzz.write_whole(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("kind", COUNTS)
def test_mutated_files(kind: str, whole: dict[str, Path], tmp_path: Path) -> None:
    outcomes = [fuzz.judge((kind, str(whole[kind]), s, str(tmp_path))) for s in range(COUNTS[kind])]
    failed = [outcome.printed for outcome in outcomes if outcome.word == "FAILED"]
    assert not failed, failed[0]
    assert {outcome.word for outcome in outcomes} <= {"whole", "with a loss", "refused"}


@pytest.mark.parametrize("kind", COUNTS)
def test_whole_files_are_read(kind: str, whole: dict[str, Path], tmp_path: Path) -> None:
    copy = tmp_path / whole[kind].name
    copy.write_bytes(whole[kind].read_bytes())
    read = fuzz.read_bag if kind.startswith("mcap") else fuzz.read_log
    assert read(copy) == ("whole", "")
