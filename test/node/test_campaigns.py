# SPDX-License-Identifier: Apache-2.0
"""The campaigns of benchmarks/endings.py and faults.py, in short."""

import random
import shutil
from pathlib import Path

import endings
import faults
import pytest
from excerpts import PARAMETERS, excerpt
from hostile import Hostile, example, leaves
from programs import python
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu

MESSAGES = 300
"""Hostile ones on every input; the campaign sends 100,000."""

SHORT = {"LEARNING_TIME": 12.0, "FLOOD_TIME": 0.1, "SILENCE": 0.1, "LARGEST_LOSS": 5.0}
"""What the campaign takes longer for: a minute of flight makes up for the storm, this does not
quite."""


def test_a_node_killed_while_it_saves_leaves_a_whole_file_and_the_next_goes_on() -> None:
    # A process of its own: in leaving a graph of killed participants, Fast DDS may crash.
    done = python("benchmarks/endings.py", "kills", "--count", "2", timeout=300.0)
    first, verdict = done.stdout.splitlines()
    assert first.startswith("2 kills")
    assert int(first.split()[2]) > 2, "files written"
    assert verdict == endings.PROGRAMS["kills"][-1]


def test_a_node_ended_by_signals_has_saved_what_it_learned() -> None:
    done = python("benchmarks/endings.py", "signals", "--count", "2", timeout=300.0)
    first, verdict = done.stdout.splitlines()
    assert first.startswith("2 nodes ended; ")
    learned, left = int(first.split()[3]), int(first.split()[6])
    assert 1 <= learned <= left
    assert verdict == endings.PROGRAMS["signals"][-1]


@pytest.mark.parametrize("sim_time", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_nothing_that_a_graph_can_do_brings_the_node_down(
    sim_time: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = excerpt(tmp_path / "multisine", 30.0)
    shutil.copy(PARAMETERS, bag)
    for name, value in {**SHORT, "BAG": bag}.items():
        monkeypatch.setattr(faults, name, value)
    campaign = faults.Campaign(seed=2, count=MESSAGES, sim_time=sim_time, folder=tmp_path)
    outcome = campaign.run()
    assert outcome.problems == []
    assert all(outcome.hostile[topic] >= MESSAGES for topic in campaign.topics)
    assert sum(outcome.calls.values()) > 20
    assert outcome.before is not None
    assert (outcome.before.model > 50.0).all()


def test_hostile_messages_are_of_every_kind_and_the_same_for_a_seed() -> None:
    made = [Hostile(Imu, random.Random(3)) for _ in range(2)]
    first, again = ([h.message(10**18) for _ in range(400)] for h in made)
    # Serialized messages are padded with whatever was in memory.
    assert [(len(d), d[4:12]) for d in first] == [(len(d), d[4:12]) for d in again]
    assert len(list(leaves(example(Imu)))) == 4 + 3 + 3 + 3 * 9
    broken, values = 0, set()
    for data in first:
        try:
            imu = deserialize_message(data, Imu)
        except (RuntimeError, UnicodeDecodeError):
            broken += 1
            continue
        values |= {str(imu.angular_velocity.x), str(imu.orientation_covariance[4])}
    assert broken > 40
    assert {"nan", "inf", "-inf", "5e-324"} <= values
