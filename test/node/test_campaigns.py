# SPDX-License-Identifier: Apache-2.0
"""The campaigns of benchmarks/endings.py and faults.py, in short."""

import shutil
from pathlib import Path

import endings
import faults
import pytest
from excerpts import PARAMETERS, excerpt
from programs import python

MESSAGES = 300
"""Number of hostile messages on every input; the campaign sends 100,000."""

SHORT = {
    "LEARNING_TIME": 7.0,
    "PIECE_TIME": 1.0,
    "FLOOD_TIME": 0.1,
    "SILENCE": 0.1,
    "LARGEST_LOSS": 5.0,
}
"""Shorter times than in the campaign. There a minute of flight restores the fit; here the fit
stays slightly lower."""


def test_a_node_killed_while_saving_leaves_a_complete_state_file() -> None:
    # In a separate process: Fast DDS may crash on leaving a graph of killed participants.
    done = python("benchmarks/endings.py", "kills", "--count", "2", timeout=300.0)
    first, verdict = done.stdout.splitlines()
    assert first.startswith("2 kills")
    assert int(first.split()[2]) > 2, "files written"
    assert verdict == endings.PROGRAMS["kills"][-1]


@pytest.mark.parametrize("sim_time", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_random_messages_and_calls_leave_the_node_running_and_its_fit_high(
    sim_time: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = excerpt(tmp_path / "multisine", 8.0)
    shutil.copy(PARAMETERS, bag)
    for name, value in {**SHORT, "MULTISINE": bag}.items():
        monkeypatch.setattr(faults, name, value)
    campaign = faults.Campaign(seed=2, count=MESSAGES, sim_time=sim_time, folder=tmp_path)
    campaign.run()
    assert campaign.problems == []
    assert all(campaign.hostile[topic] >= MESSAGES for topic in campaign.topics)
    assert sum(campaign.calls.values()) > 20
    assert campaign.before is not None
    assert (campaign.before.model > 50.0).all()
