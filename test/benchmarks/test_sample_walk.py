# SPDX-License-Identifier: Apache-2.0
"""What a gyro sample passes on its way."""

import pytest
import sample_walk
from programs import Capture


def test_the_walk_of_a_sample_leads_through_the_parts_in_their_order(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(sample_walk, "LEARNING", 1.0)
    sample_walk.main([])
    *files, last = capsys.readouterr().out.splitlines()
    counts = [int(line.split()[0]) for line in files]
    assert last.startswith(f"{len(files)} files, {sum(counts)} functions ")
    names = [line.split()[1].removeprefix("identification/") for line in files]
    parts = ["messages/feed.py", "identifier.py", "samples.py", "regression.py", "supervision.py"]
    assert set(parts) <= set(names) and names[0] == parts[0]
