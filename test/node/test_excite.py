# SPDX-License-Identifier: Apache-2.0
"""The service ``~/excite``, the topic ``~/excitation`` over DDS, and its addition."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from estimates import estimate_of
from excerpts import summary
from programs import PATIENCE
from recordings import NODE, Fly, Player, Recording, change, encoded, recording
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from uav_ident_ros.bags.writing import JOINT_STATE, joint_state
from uav_ident_ros.client import Excitation, subscribe_excitation
from uav_ident_ros.guest import Guest
from uav_ident_ros.identification.excitation_run import Flying
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import EXCITATION_TIMEOUT, Settings
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.node.excite import Excite, slowest_ticks

MS = 1_000_000
PARAMETERS = {
    "excitation.max_rate": "50.0",  # the recorded rates are high
    "excitation.amplitude": "[0.01, 0.02, 0.03, 0.0]",
    "excitation.fade_time": "0.0",
    "excitation.band": "[0.5, 3.0]",
}


@pytest.fixture(scope="module")
def flight() -> Recording:
    return recording("multisine", 8.0)


def collect_excitation(player: Player) -> list[JointState]:
    """Subscribe to the excitation; return the growing list of its messages."""
    received: list[JointState] = []
    player.node.create_subscription(JointState, f"{NODE}/excitation", received.append, 1000)
    return received


def positions(messages: list[JointState]) -> np.ndarray:
    return np.array([message.position for message in messages]).reshape(-1, len(INPUTS))


@pytest.fixture(scope="module")
def player(flight: Recording, shared_fly: Fly) -> Player:
    """Return a player for a node that starts cold at every restart of the recording."""
    return shared_fly(flight, parameters=PARAMETERS, sim_time=True)[1]


def test_a_run_is_published_tick_by_tick_and_aborted_at_once(
    flight: Recording, player: Player
) -> None:
    received, excitation = collect_excitation(player), Excitation(limit=[0.1] * 4)
    subscribe_excitation(player.node, excitation)
    player.play_in_step(flight.part(0.0, 2.0))
    received.clear()
    assert player.call(SetBool, "excite", data=True).success
    assert not player.call(SetBool, "excite", data=True).success
    player.play_in_step(flight.part(2.0, 5.0))
    stamps = [header_ns(m) for m in received]
    assert {tuple(m.name) for m in received} == {INPUTS}
    assert set(np.diff(stamps)) == {50 * MS}
    ticks = {header_ns(m) for m in player.outputs.named}
    assert {t - 150 * MS for t in stamps} >= ticks - {min(ticks)}  # one for each tick
    requested = positions(received)
    assert (np.abs(requested).max(axis=0) > [0.006, 0.012, 0.018, -1.0]).all()
    assert (np.abs(requested).max(axis=0) <= [0.0101, 0.0202, 0.0303, 0.0]).all()
    assert np.array_equal(excitation.at(stamps[-1]), requested[-1])  # at a controller
    values = player.entries()
    assert values["excite: state"] == "running"
    assert float(values["excite: elapsed [s]"]) > 2.0
    assert {"excite: not known yet", "excite: until known [s]"} <= values.keys()

    received.clear()
    answer = player.call(SetBool, "excite", data=False)
    assert answer.success and answer.message == "excitation is zero"
    player.wait_until(lambda: len(received) > 0, "zero")
    assert header_ns(received[0]) < stamps[-1]  # the scheduled excitation is cancelled
    player.play_in_step(flight.part(5.0, 8.0))
    assert not positions(received).any() and not excitation.at(stamps[-1]).any()
    assert len(received) < 20  # half a second, then no message
    assert player.entries()["excite: last run"] == "aborted: asked for"


def test_a_run_is_aborted_when_no_input_messages_arrive(flight: Recording, player: Player) -> None:
    received = collect_excitation(player)
    player.play_in_step(flight.part(0.0, 2.0))
    assert player.call(SetBool, "excite", data=True).success
    now_ns = flight.part(0.0, 2.0)[-1].log_ns + 100 * MS
    player.clock.send(now_ns + 220 * MS)
    player.spin_for(0.8)  # a third of a second by the node's clock
    assert not received
    for k in range(22, 60):  # time alone advances
        player.clock.send(now_ns + k * 10 * MS)
        player.spin_for(0.02)
    player.wait_until(lambda: player.entries()["excite: state"] == "idle", "the end of the run")
    assert "no ticks any more" in player.entries()["excite: last run"]
    assert not positions(received[-1:]).any()


def test_a_replay_reads_the_excitation_and_equals_the_live_node_to_the_bit(
    flight: Recording, player: Player, tmp_path: Path
) -> None:
    """The live node applies its excitation directly, the replay by messages."""
    received = collect_excitation(player)
    player.play_in_step(flight.part(0.0, 2.0))
    live = player.ticks()
    assert player.call(SetBool, "excite", data=True).success
    player.play_in_step(flight.part(2.0, 8.0))
    live |= player.ticks()
    topic = f"{NODE}/excitation"
    # earliest publication: with its tick, `input_wait` later
    words = []
    for m in received:  # the bytes on DDS: without the padding by `serialize_message`
        joints = joint_state(header_ns(m), m.name, m.position)
        words.append(encoded(topic, header_ns(m) - 100 * MS, joints))
    assert len(words) > 100 and positions(received).any()
    both = sorted([*flight.messages, *words], key=lambda message: message.log_ns)
    types = {**flight.types, topic: JOINT_STATE}
    offline = replace(flight, messages=both, types=types).replayed(tmp_path)
    assert summary(tmp_path / "out")["inputs"]["excitation"]["dropped"] == {}
    common = sorted(offline.keys() & live.keys())
    assert len(common) > 140
    assert {t: offline[t] for t in common} == {t: live[t] for t in common}


def test_a_probe_measures_the_control_derivatives(flight: Recording, player: Player) -> None:
    player.play_in_step(flight.part(0.0, 2.0))
    player.call(SetBool, "excite", data=False)
    change(player, {"excitation.form": "probe", "excitation.band": [1.0, 5.0]})
    assert player.call(SetBool, "excite", data=True).success
    player.play_in_step(flight.part(2.0, 8.0))
    values = player.entries()
    assert values["excite: last run"].startswith("complete")
    for name, coefficient, true in (("da", "pdot/da", 59.9), ("de", "qdot/de", -39.6)):
        label, _, value, *_ = values[f"excite: effect of {name}"].split()
        assert (label, float(value)) == (coefficient, pytest.approx(true, rel=0.1))


def test_a_run_is_aborted_between_a_restart_of_the_filters_and_the_next_sample(
    flight: Recording, player: Player
) -> None:
    player.play_in_step(flight.part(0.0, 2.0))
    player.call(SetBool, "excite", data=False)
    assert player.call(SetBool, "excite", data=True).success
    change(player, {"filter.cutoff": 14.0})
    answer = player.call(SetBool, "excite", data=False)
    assert answer.success and answer.message == "excitation is zero"
    assert player.entries()["internal errors"] == "0"


def test_the_own_signal_counts_only_while_nobody_else_publishes_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    identifier, taken = OnlineIdentifier(Settings()), list[int]()
    monkeypatch.setattr(identifier, "flying", lambda: Flying(np.zeros(3)))
    monkeypatch.setattr(identifier, "add_excitation", lambda t_ns, *_, **__: taken.append(t_ns))
    guest = Guest("excite")
    try:
        injected = guest.node.create_subscription(JointState, "excitation", print, 1)
        excite = Excite(guest.node, identifier, injected)

        def tick(t_ns: int) -> None:
            excite.tick(estimate_of(np.ones(identifier.structure.mask.shape), t_ns=t_ns))

        tick(100 * MS)
        assert excite.request(True)[0]
        tick(150 * MS)
        assert taken == [300 * MS]
        other = guest.node.create_publisher(JointState, "excitation", 1)
        assert guest.spin_for(PATIENCE, lambda: guest.node.count_publishers(other.topic_name) > 0)
        assert guest.spin_for(1.0, lambda: injected.get_publisher_count() > 0)
        monkeypatch.setattr(guest.node, "count_publishers", None)  # no query of the graph at a tick
        tick(200 * MS)
        assert taken == [300 * MS]
        guest.node.destroy_publisher(other)
        assert guest.spin_for(PATIENCE, lambda: injected.get_publisher_count() == 0)
        tick(250 * MS)
        assert taken == [300 * MS, 400 * MS]
    finally:
        guest.close()


def test_excitation_is_refused_without_ticks_and_at_too_low_an_update_rate(
    flight: Recording, fly: Fly
) -> None:
    assert slowest_ticks(3.0) == 12.0  # four in a cycle
    assert slowest_ticks(1.0) == 2.0 / EXCITATION_TIMEOUT  # one may be lost
    _, player = fly(flight, parameters={**PARAMETERS, "update_rate": "10.0"}, sim_time=True)
    answer = player.call(SetBool, "excite", data=True)
    assert not answer.success and "not started: there are no ticks" in answer.message
    player.play_in_step(flight.part(0.0, 2.0))
    answer = player.call(SetBool, "excite", data=True)
    assert not answer.success and answer.message.endswith("need 12 Hz")
