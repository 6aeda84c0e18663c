# SPDX-License-Identifier: Apache-2.0
"""Services, names and QoS, as the public contract has them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from node_process import StartNode
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from recordings import (
    ACTUATORS_TOPIC,
    NODE,
    RATES_TOPIC,
    MakePlayer,
    Recording,
    call,
    published,
    recording,
    wait_for_status,
)
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from uav_ident_ros.bags.reading import Message
from uav_ident_ros.files.coefficients_file import load_coefficients


@pytest.fixture
def flight() -> Recording:
    return recording("multisine", 5.0)


def test_diagnostics_tell_what_a_pilot_asks(
    flight: Recording, start_node: StartNode, make_player: MakePlayer
) -> None:
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    player.play_in_step(flight.messages)
    assert call(player, Trigger, f"{NODE}/save", Trigger.Request()).success
    player.play_in_step(flight.messages)
    wait_for_status(player)
    shown = {entry.key: entry.value for entry in player.outputs.status[-1].values}
    assert float(shown["saved fit p [%]"]) != 0.0
    for key in ("fit q [%]", "hold q [%]", "delay [s]", "excitation qdot [0..1]"):
        assert math.isfinite(float(shown[key]))
    assert shown["changed in flight"] == "nothing"
    assert float(shown["ticks: update time p99 [ms]"]) > 0.0
    assert float(shown["ticks: timer jitter p99 [ms]"]) >= 0.0
    assert math.isfinite(float(shown["ticks: age when published p99 [ms]"]))
    for stream, topic in (("rates", RATES_TOPIC), ("actuators", ACTUATORS_TOPIC)):
        assert shown[f"{stream}: topic"] == topic
        assert int(shown[f"{stream}: messages"]) > 0
        assert float(shown[f"{stream}: age [s]"]) >= 0.0
        assert int(shown[f"{stream}: dropped"]) >= 0


def test_reset_starts_cold(
    flight: Recording, start_node: StartNode, make_player: MakePlayer
) -> None:
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    player.play_in_step(flight.messages)
    first = published(player.outputs)
    assert call(player, Trigger, f"{NODE}/reset", Trigger.Request()).success
    player.play_in_step(flight.messages)
    assert len(first) > 80
    assert published(player.outputs) == first


def test_adapt_switches_learning_off_and_on(
    flight: Recording, start_node: StartNode, make_player: MakePlayer
) -> None:
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    start_ns = flight.messages[0].log_ns
    parts = [
        [m for m in flight.messages if begin * 1e9 <= m.log_ns - start_ns < (begin + 1.5) * 1e9]
        for begin in (0.0, 1.5, 3.0)
    ]
    player.play_in_step(parts[0])
    learned = player.outputs.coefficients[-1].data
    assert call(player, SetBool, f"{NODE}/adapt", SetBool.Request(data=False)).success
    player.play_in_step(parts[1])
    assert {tuple(m.data) for m in player.outputs.coefficients} == {tuple(learned)}
    player.wait_until(
        lambda: any("switched off" in s.message for s in player.outputs.status), "the state"
    )
    assert call(player, SetBool, f"{NODE}/adapt", SetBool.Request(data=True)).success
    player.play_in_step(parts[2])
    assert player.outputs.coefficients[-1].data != learned


def test_save_writes_what_is_published(
    flight: Recording, start_node: StartNode, make_player: MakePlayer, ros_home: Path
) -> None:
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    nothing = call(player, Trigger, f"{NODE}/save", Trigger.Request())
    assert not nothing.success
    assert "no estimate" in nothing.message
    player.play_in_step(flight.messages)
    answer = call(player, Trigger, f"{NODE}/save", Trigger.Request())
    assert answer.success, answer.message
    path = ros_home / "uav_ident_ros" / "identifier.yaml"
    assert str(path) in answer.message
    player.wait_until(path.exists, "the file")
    saved = load_coefficients(path)
    dense = np.array(player.outputs.coefficients[-1].data).reshape(saved.values.shape)
    assert np.array_equal(saved.values, dense)
    assert saved.t_ns == player.outputs.newest_ns


def test_it_starts_from_a_file_that_it_saved(
    flight: Recording, start_node: StartNode, make_player: MakePlayer, ros_home: Path
) -> None:
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    player.play_in_step(flight.messages)
    call(player, Trigger, f"{NODE}/save", Trigger.Request())
    saved = ros_home / "uav_ident_ros" / "identifier.yaml"
    player.wait_until(saved.exists, "the file")
    learned = player.outputs.coefficients[-1].data
    start_node(
        "-r",
        "__ns:=/second",
        parameter_file=flight.parameter_file,
        parameters={"initial_coefficients_file": str(saved)},
    )
    second = in_namespace(flight, "/second")
    other = make_player(second, node_name="/second/identifier", clock=False)
    other.wait_for_node()
    other.play_in_step(second.messages)
    assert other.outputs.coefficients[0].data == learned


def in_namespace(flight: Recording, namespace: str) -> Recording:
    """Move the topics of a recording into a namespace."""
    return replace(
        flight,
        messages=[Message(f"{namespace}{m.topic}", m.log_ns, m.data) for m in flight.messages],
        types={f"{namespace}{topic}": name for topic, name in flight.types.items()},
    )


def test_a_coarse_clock_is_named(
    flight: Recording, start_node: StartNode, make_player: MakePlayer
) -> None:
    """Every step of 'time_jump' restarts the filters: there would never be a tick."""
    node = start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight)
    player.wait_for_node()
    for step in range(1, 100):
        player.send_clock(1_700_000_000_000_000_000 + step * 1_500_000_000)
        player.spin_for(0.2)
        if "/clock moves in steps of 1.5 s, and each of 'time_jump' (1 s)" in node.log:
            break
    else:
        raise AssertionError(node.log)


def test_quality_of_service_is_the_contracts(
    flight: Recording, start_node: StartNode, make_player: MakePlayer
) -> None:
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    for name in ("coefficients_named", "coefficients"):
        (out,) = player.node.get_publishers_info_by_topic(f"{NODE}/{name}")
        assert out.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert out.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    for name in ("predicted_rates", "prediction_error"):
        (out,) = player.node.get_publishers_info_by_topic(f"{NODE}/{name}")
        assert out.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert out.qos_profile.durability == DurabilityPolicy.VOLATILE
    for topic in flight.types:
        (used,) = player.node.get_subscriptions_info_by_topic(topic)
        assert used.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT


def test_late_subscriber_gets_the_last_coefficients(
    flight: Recording, start_node: StartNode, make_player: MakePlayer
) -> None:
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    player.play_in_step(flight.messages[:1000])
    late: list[JointState] = []
    latched = QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )
    player.node.create_subscription(JointState, f"{NODE}/coefficients_named", late.append, latched)
    player.wait_until(lambda: bool(late), "the last coefficients")
    assert late[0] == player.outputs.named[-1]
