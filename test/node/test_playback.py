# SPDX-License-Identifier: Apache-2.0
"""Bags played to the node over DDS: it publishes what the offline replay computes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from node_process import StartNode
from recordings import MakePlayer, published, recording, replayed, wait_for_status, write_bag

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.offline.run import OfflineRun, choose_inputs
from uav_ident_ros.player import stamp_ns

ON_TIME = 2e-3
"""How late the player may be, s rms: a machine too busy for real time says nothing."""

ATTEMPTS = 3


def test_same_to_the_bit_as_replay_with_clock(
    start_node: StartNode, make_player: MakePlayer, tmp_path: Path
) -> None:
    """Stamped actuators, every message delivered: every value of every tick is the same."""
    flight = recording("multisine", 20.0)
    start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight)
    player.wait_for_node()
    player.play_in_step(flight.messages)
    offline = replayed(flight, tmp_path)
    assert len(offline) > 380
    assert published(player.outputs) == offline


def test_same_to_the_bit_as_replay_without_clock(
    start_node: StartNode, make_player: MakePlayer, tmp_path: Path
) -> None:
    """Stamps rule, not the clock: the same on system time (and on the events executor)."""
    flight = recording("multisine", 8.0)
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    player.play_in_step(flight.messages)
    offline = replayed(flight, tmp_path)
    assert len(offline) > 140
    assert published(player.outputs) == offline


def test_dense_coefficients_are_those_published_by_name(
    start_node: StartNode, make_player: MakePlayer
) -> None:
    flight = recording("multisine", 3.0)
    start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight)
    player.wait_for_node()
    player.play_in_step(flight.messages)
    dense, named = player.outputs.coefficients[-1], player.outputs.named[-1]
    rows = dense.layout.dim[0].label.split(",")
    columns = dense.layout.dim[1].label.split(",")
    matrix = np.array(dense.data).reshape(len(rows), len(columns))
    found = {
        f"{row}/{column}": matrix[i, j]
        for i, row in enumerate(rows)
        for j, column in enumerate(columns)
        if f"{row}/{column}" in named.name
    }
    assert found == {
        name: value
        for name, value in zip(named.name, named.position, strict=True)
        if name.startswith(tuple(rows))
    }
    verdicts = [f"verdict/usable{row}" for row in ("", "/pdot", "/qdot", "/rdot")]
    assert named.name[-7:] == ["fit/p", "fit/q", "fit/r", *verdicts]


def test_unstamped_actuators_at_real_time_fit_within_a_point(
    start_node: StartNode, make_player: MakePlayer, tmp_path: Path
) -> None:
    """Stamped on arrival by /clock at 100 Hz, the inputs are a few milliseconds off."""
    flight = recording("pulses", 20.0)
    start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight)
    player.wait_for_node()
    for _ in range(ATTEMPTS):
        player.outputs.clear()
        late = player.play(flight.messages)  # again from the start: the node starts cold
        player.spin_for(0.5)
        if late < ON_TIME:
            break
    else:
        pytest.skip("this machine is too busy to play a bag in real time")
    ticks = [stamp_ns(m.header.stamp) for m in player.outputs.named]
    assert len(ticks) == len(player.outputs.coefficients)
    live = dict(zip(ticks, (m.data for m in player.outputs.coefficients), strict=True))
    with Bag(write_bag(flight, tmp_path / "flight")) as bag:
        inputs = choose_inputs(bag, load_parameters(flight.parameter_file, "identifier"))
        run = OfflineRun(inputs)
        run.run(bag, lambda messages, _: messages)
    offline = run.score()["last_40_percent"].model
    missing = [e.t_ns for e in run.estimates if e.t_ns not in live]
    assert not missing
    shape = run.structure.mask.shape
    run.estimates = [
        replace(e, coefficients=np.array(live[e.t_ns]).reshape(shape)) for e in run.estimates
    ]
    assert np.abs(run.score()["last_40_percent"].model - offline).max() < 1.0


def test_looped_bag_starts_cold_every_time(start_node: StartNode, make_player: MakePlayer) -> None:
    flight = recording("multisine", 5.0)
    node = start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight)
    player.wait_for_node()
    player.play_in_step(flight.messages)
    first = published(player.outputs)
    player.play_in_step(flight.messages)
    assert "/clock jumped by -5." in node.log
    assert "starting cold" in node.log
    assert len(first) > 80
    assert published(player.outputs) == first


def test_jump_ahead_keeps_the_coefficients(start_node: StartNode, make_player: MakePlayer) -> None:
    flight = recording("multisine", 12.0)
    start_ns = flight.messages[0].log_ns
    before = [m for m in flight.messages if m.log_ns < start_ns + int(5e9)]
    after = [m for m in flight.messages if m.log_ns > start_ns + int(9e9)]
    node = start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight)
    player.wait_for_node()
    player.play_in_step(before)
    learned = player.outputs.coefficients[-1].data
    player.play_in_step(after)
    assert "filters restart, the coefficients stay" in node.log
    assert player.outputs.coefficients[0].data == learned
    assert player.outputs.coefficients[-1].data != learned


def test_bag_played_without_clock_is_a_fault_that_says_so(
    start_node: StartNode, make_player: MakePlayer
) -> None:
    flight = recording("pulses", 3.0)
    node = start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    player.play(flight.messages)
    wait_for_status(player)
    faults = [s for s in player.outputs.status if s.message.startswith("fault: ")]
    assert faults
    assert "different clocks" in faults[-1].message
    assert "--clock" in faults[-1].message
    assert faults[-1].level == b"\x02"
    assert "--clock" in node.log


def test_simulated_time_without_clock_is_reported(
    start_node: StartNode, make_player: MakePlayer
) -> None:
    """/diagnostics is on a steady clock: it speaks up exactly when the node's clock is silent."""
    flight = recording("pulses", 0.5)
    node = start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight, clock=False)
    player.wait_until(
        lambda: any("nothing arrives on /clock" in s.message for s in player.outputs.status),
        "a status about /clock",
    )
    assert "nothing arrives on /clock" in node.log
    assert player.outputs.named == []
