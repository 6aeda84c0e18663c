# SPDX-License-Identifier: Apache-2.0
"""Services, names and QoS, as the public contract has them: one node, set back for each test."""

from pathlib import Path

import numpy as np
import pytest
import recordings
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger

from uav_ident_ros.files.coefficients_file import load_coefficients
from uav_ident_ros.player import Player


@pytest.fixture(scope="module")
def flight() -> recordings.Recording:
    return recordings.recording("multisine", 5.0)


@pytest.fixture(scope="module")
def shared(flight: recordings.Recording, shared_fly: recordings.Fly) -> Player:
    return shared_fly(flight)[1]


@pytest.fixture
def player(shared: Player) -> Player:
    """A player for a node that starts cold."""
    assert recordings.call(shared, Trigger, "reset").success
    shared.outputs.clear()
    return shared


def test_reset_starts_cold(flight: recordings.Recording, player: Player) -> None:
    player.play_in_step(flight.messages)
    first = recordings.published(player.outputs)
    assert recordings.call(player, Trigger, "reset").success
    player.play_in_step(flight.messages)
    assert len(first) > 80
    assert recordings.published(player.outputs) == first


def test_save_writes_what_is_published_and_diagnostics_compare_with_it(
    flight: recordings.Recording, player: Player
) -> None:
    nothing = recordings.call(player, Trigger, "save")
    assert not nothing.success
    assert "no estimate" in nothing.message
    player.play_in_step(flight.messages)
    answer = recordings.call(player, Trigger, "save")
    assert answer.success, answer.message
    path = Path(answer.message.split("'")[1])
    assert path.parts[-2:] == ("uav_ident_ros", "identifier.yaml")
    player.wait_until(path.exists, "the file")
    saved = load_coefficients(path)
    dense = np.array(player.outputs.coefficients[-1].data).reshape(saved.values.shape)
    assert np.array_equal(saved.values, dense)
    assert saved.t_ns == player.outputs.newest_ns

    recordings.wait_for_status(player)  # with it the node takes note of what was written
    player.play_in_step(flight.messages)
    values, newest = recordings.shown(player), player.outputs.named[-1]
    assert float(values["saved fit p [%]"]) != 0.0
    fit = newest.position[list(newest.name).index("fit/q")]
    assert float(values["fit q [%]"]) == pytest.approx(fit, abs=0.06)
    assert 0.0 < float(values["excitation qdot [0..1]"]) <= 1.0
    assert values["changed in flight"] == "nothing"
    assert 0.0 < float(values["ticks: update time p99 [ms]"]) < 1000.0
    for stream, topic in (
        ("rates", recordings.RATES_TOPIC),
        ("actuators", recordings.ACTUATORS_TOPIC),
    ):
        assert values[f"{stream}: topic"] == topic
        assert int(values[f"{stream}: messages"]) >= 2 * sum(
            m.topic == topic for m in flight.messages
        )


def test_adapt_switches_learning_off_and_on(flight: recordings.Recording, player: Player) -> None:
    player.play_in_step(recordings.part(flight, 0.0, 1.5))
    learned = player.outputs.coefficients[-1].data
    assert recordings.call(player, SetBool, "adapt", data=False).success
    player.play_in_step(recordings.part(flight, 1.5, 3.0))
    assert {tuple(m.data) for m in player.outputs.coefficients} == {tuple(learned)}
    recordings.wait_for_words(player, "switched off")
    assert recordings.call(player, SetBool, "adapt", data=True).success
    player.play_in_step(recordings.part(flight, 3.0, 4.5))
    assert player.outputs.coefficients[-1].data != learned


def test_quality_of_service_is_the_contracts(flight: recordings.Recording, player: Player) -> None:
    def profile(topic: str) -> QoSProfile:
        (end,) = player.node.get_publishers_info_by_topic(f"{recordings.NODE}/{topic}")
        return end.qos_profile

    for name in ("coefficients_named", "coefficients"):
        assert profile(name).reliability == ReliabilityPolicy.RELIABLE
        assert profile(name).durability == DurabilityPolicy.TRANSIENT_LOCAL
    for name in ("predicted_rates", "prediction_error"):
        assert profile(name).reliability == ReliabilityPolicy.RELIABLE
        assert profile(name).durability == DurabilityPolicy.VOLATILE
    for topic in flight.types:
        (used,) = player.node.get_subscriptions_info_by_topic(topic)
        assert used.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
