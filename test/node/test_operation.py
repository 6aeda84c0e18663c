# SPDX-License-Identifier: Apache-2.0
"""Services, names, QoS and optional inputs of the public contract."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from recordings import (
    ACTUATORS_TOPIC,
    NODE,
    RATES_TOPIC,
    Fly,
    Player,
    Recording,
    encoded,
    recording,
)
from std_srvs.srv import SetBool, Trigger

from uav_ident_ros.bags import writing
from uav_ident_ros.files.coefficients_file import load_coefficients
from uav_ident_ros.identification.structure import ROWS
from uav_ident_ros.node.identifier_node import MOST_WAITING, IdentifierNode


@pytest.fixture(scope="module")
def flight() -> Recording:
    return recording("multisine", 5.0)


@pytest.fixture(scope="module")
def shared(flight: Recording, shared_fly: Fly) -> Player:
    return shared_fly(flight)[1]


@pytest.fixture
def player(shared: Player) -> Player:
    """Return a player for a node that starts cold."""
    assert shared.call(Trigger, "reset").success
    shared.outputs.clear()
    return shared


def test_save_writes_the_published_coefficients_and_diagnostics_score_them(
    flight: Recording, player: Player
) -> None:
    nothing = player.call(Trigger, "save")
    assert not nothing.success
    assert "no estimate" in nothing.message
    player.play_in_step(flight.messages)
    answer = player.call(Trigger, "save")
    assert answer.success, answer.message
    path = Path(answer.message.split("'")[1])
    assert path.parts[-2:] == ("uav_ident_ros", "identifier.yaml")
    player.wait_until(path.exists, "the file")
    saved = load_coefficients(path)
    dense = np.array(player.outputs.coefficients[-1].data).reshape(saved.values.shape)
    assert np.array_equal(saved.values, dense)
    assert saved.t_ns == player.outputs.newest_ns

    player.wait_for_status()  # the status timer registers the written file
    player.play_in_step(flight.messages)
    values, newest = player.entries(), player.outputs.named[-1]
    assert float(values["saved fit p [%]"]) != 0.0
    fit = newest.position[list(newest.name).index("fit/q")]
    assert float(values["fit q [%]"]) == pytest.approx(fit, abs=0.06)
    excitation = [float(values[f"excitation {row} [0..1]"]) for row in ROWS]
    assert 0.0 < max(excitation) <= 1.0, excitation
    assert values["changed in flight"] == "nothing"
    assert 0.0 < float(values["ticks: update time p99 [ms]"]) < 1000.0
    for stream, topic in (("rates", RATES_TOPIC), ("actuators", ACTUATORS_TOPIC)):
        assert values[f"{stream}: topic"] == topic
        count = sum(message.topic == topic for message in flight.messages)
        assert int(values[f"{stream}: messages"]) >= 2 * count


def test_adapt_switches_learning_off_and_on(flight: Recording, player: Player) -> None:
    player.play_in_step(flight.part(0.0, 1.5))
    learned = player.outputs.coefficients[-1].data
    assert player.call(SetBool, "adapt", data=False).success
    player.play_in_step(flight.part(1.5, 3.0))
    assert {tuple(m.data) for m in player.outputs.coefficients} == {tuple(learned)}
    player.wait_for_text("switched off")
    assert player.call(SetBool, "adapt", data=True).success
    player.play_in_step(flight.part(3.0, 4.5))
    assert player.outputs.coefficients[-1].data != learned


def test_quality_of_service_is_as_contracted(flight: Recording, player: Player) -> None:
    latched, volatile = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
    for topic, durability in {
        "coefficients_named": latched,
        "coefficients": latched,
        "predicted_rates": volatile,
        "prediction_error": volatile,
    }.items():
        (end,) = player.node.get_publishers_info_by_topic(f"{NODE}/{topic}")
        assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert end.qos_profile.durability == durability
    for topic in flight.types:
        (used,) = player.node.get_subscriptions_info_by_topic(topic)
        assert used.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT


AIRSPEED, ARMED = "/airspeed", "/armed"
NUMBER, FLAG = "std_msgs/msg/Float64", "std_msgs/msg/Bool"
EVERY = 20
"""Messages of the flight per airspeed: about 12 Hz."""


def test_node_learns_with_an_airspeed_and_only_while_armed(fly: Fly) -> None:
    """Neither has stamps, and arrivals are years from the recorded ones."""
    plain = recording("multisine", 6.5)
    flight = replace(plain, types={**plain.types, AIRSPEED: NUMBER, ARMED: FLAG})
    node, player = fly(flight, parameters={"airspeed.type": NUMBER, "armed.type": FLAG})
    learned = player.outputs.coefficients
    count = dropped = 0

    def play(begin: float, end: float, armed: bool) -> None:
        nonlocal count, dropped
        chosen = flight.part(begin, end)
        messages = [encoded(ARMED, chosen[0].log_ns, writing.plain(FLAG, armed))]
        for number, message in enumerate(chosen):
            messages.append(message)
            if number % EVERY == 0:
                bad = number % (5 * EVERY) == 0
                speed = writing.plain(NUMBER, math.nan if bad else 20.0)
                messages.append(encoded(AIRSPEED, message.log_ns, speed))
                count, dropped = count + 1, dropped + bad
        player.play_in_step(messages)

    player.play_in_step(flight.part(0.0, 2.0))
    player.wait_for_text("no message on '/airspeed' yet")
    play(2.0, 3.5, armed=False)
    assert len({tuple(m.data) for m in learned}) == 1
    player.wait_for_text("not armed")
    play(3.5, 5.0, armed=True)
    assert learned[-1].data != learned[0].data
    play(5.0, 6.5, armed=False)
    assert learned[-1].data == learned[-20].data
    for topic in (AIRSPEED, ARMED):
        assert f"'{topic}': its messages carry no time" in node.log
    values = player.entries()
    assert int(values["airspeed: dropped: not finite"]) == dropped
    assert int(values["airspeed: messages"]) == count
    assert "'/armed': message dropped" not in node.log


@pytest.mark.parametrize("jump_ns", [0, 60_000_000_000])
def test_nothing_piles_up_while_the_clock_stands_still(jump_ns: int) -> None:
    """Ticks are due and wait; after a jump of the stamps the messages are held back for them."""
    rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true", "-p", "state_file:=none"])
    node = IdentifierNode()
    intake = node.identifier.intake
    for k in range(MOST_WAITING + 20):
        t_ns = 10**18 + 50_000_000 * k + (jump_ns if k > 9 else 0)
        intake.add_rates(t_ns, (0.1, 0.0, 0.0), (0.0, 0.0, -9.8))
    assert intake.waiting > MOST_WAITING
    node._on_diagnostics()
    assert intake.waiting == 0
    node.destroy_node()
    rclpy.shutdown()
