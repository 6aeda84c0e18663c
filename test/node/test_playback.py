# SPDX-License-Identifier: Apache-2.0
"""Bags played to the node over DDS: its outputs equal the offline replay."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from excerpts import excerpt
from recordings import NODE, Fly, Player, Recording, recording
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.offline.run import run_over
from uav_ident_ros.offline.ticks import Ticks
from uav_ident_ros.process import NodeProcess

SPEEDS = (1.0, 0.3, 0.1)
"""Multiples of real time, one after the other: a busy machine stamps late, by less of the
recording's time at a lower speed."""


@pytest.fixture(scope="module")
def flight() -> Recording:
    return recording("multisine", 12.0)


@pytest.fixture(scope="module")
def shared(flight: Recording, shared_fly: Fly) -> tuple[NodeProcess, Player]:
    """Return a node and a player; the node starts cold whenever /clock jumps back."""
    node, player = shared_fly(flight, sim_time=True)
    # /diagnostics uses a steady clock, so it reports a missing /clock
    player.wait_for_text("nothing arrives on /clock")
    assert "nothing arrives on /clock" in node.log
    assert player.outputs.named == []
    return node, player


def test_every_value_of_every_tick_equals_the_replay_to_the_bit(
    flight: Recording, shared: tuple[NodeProcess, Player], tmp_path: Path
) -> None:
    """Actuators are stamped, and every message is delivered.

    On system time, without /clock: test_hostile_input.py.
    """
    _, player = shared
    player.play_in_step(flight.messages)
    offline = flight.replayed(tmp_path)
    assert len(offline) > 230
    assert player.ticks() == offline


def test_a_looped_bag_starts_cold_and_a_jump_ahead_keeps_the_coefficients(
    flight: Recording, shared: tuple[NodeProcess, Player]
) -> None:
    node, player = shared
    player.play_in_step(flight.part(0.0, 5.0))
    first = player.ticks()
    player.play_in_step(flight.part(0.0, 5.0))
    assert "/clock jumped by -5." in node.log
    assert "starting cold" in node.log
    assert len(first) > 80
    assert player.ticks() == first
    learned = player.outputs.coefficients[-1].data
    player.play_in_step(flight.part(9.0, 12.0))
    assert "filters restart, the coefficients stay" in node.log
    assert player.outputs.coefficients[0].data == learned
    assert player.outputs.coefficients[-1].data != learned


class Cdr:
    """Reader of little-endian XCDR1, by `struct` and docs/controllers.md alone."""

    def __init__(self, data: bytes) -> None:
        assert data[:2] == b"\x00\x01"
        self._body, self._at = data[4:], 0

    def number(self, form: str) -> float | int:
        size = struct.calcsize(form)
        self._at = (self._at + size - 1) // size * size  # aligned to its own size
        (value,) = struct.unpack_from("<" + form, self._body, self._at)
        self._at += size
        return value

    def string(self) -> str:
        length = self.number("I")  # with the terminating zero
        text = self._body[self._at : self._at + length - 1].decode()
        self._at += length
        return text

    def doubles(self) -> list[float]:
        return [self.number("d") for _ in range(self.number("I"))]


def test_both_topics_decode_from_their_bytes_by_the_documented_layout(
    flight: Recording, shared: tuple[NodeProcess, Player]
) -> None:
    _, player = shared
    player.play_in_step(flight.part(0.0, 1.0))
    raw: dict[str, list[bytes]] = {"coefficients_named": [], "coefficients": []}
    for topic, kind in (("coefficients_named", JointState), ("coefficients", Float64MultiArray)):
        player.node.create_subscription(kind, f"{NODE}/{topic}", raw[topic].append, 100, raw=True)
    player.play_in_step(flight.part(1.0, 4.0))

    decoded = player.outputs.named[-1]
    cdr = Cdr(raw["coefficients_named"][-1])
    assert cdr.number("i") * 10**9 + cdr.number("I") == header_ns(decoded)
    assert cdr.string() == ""  # frame_id
    names = [cdr.string() for _ in range(cdr.number("I"))]
    position, velocity, effort = cdr.doubles(), cdr.doubles(), cdr.doubles()
    assert names == list(decoded.name)
    assert (position, velocity, effort) == (list(decoded.position), [], list(decoded.effort))
    verdicts = [f"verdict/usable{row}" for row in ("", "/pdot", "/qdot", "/rdot")]
    assert names[-7:] == ["fit/p", "fit/q", "fit/r", *verdicts]
    assert set(position[-4:]) <= {0.0, 1.0}

    cdr = Cdr(raw["coefficients"][-1])
    dimensions = [(cdr.string(), cdr.number("I"), cdr.number("I")) for _ in range(cdr.number("I"))]
    assert cdr.number("I") == 0  # data_offset
    data = cdr.doubles()
    (rows, n_rows, size), (columns, n, stride) = dimensions
    assert (rows.split(",")[:3], n_rows) == (["pdot", "qdot", "rdot"], len(rows.split(",")))
    assert (size, stride, len(data)) == (n_rows * n, n, n_rows * n)
    value = dict(zip(names, position, strict=True))
    for row, line in zip(rows.split(","), np.array(data).reshape(n_rows, n), strict=True):
        for label, coefficient in zip(columns.split(","), line, strict=True):
            assert coefficient == value.get(f"{row}/{label}", 0.0)


def test_unstamped_actuators_in_real_time_cost_less_than_a_point(fly: Fly, tmp_path: Path) -> None:
    """Stamped on arrival by /clock at 100 Hz, the inputs are a few milliseconds off.

    A machine too busy for real time plays slower: /clock is the node's only time source.
    """
    flight = recording("pulses", 6.0)
    values = load_parameters(flight.parameter_file, "identifier")
    run = run_over(excerpt(tmp_path / "flight", 6.0, "pulses"), values)
    offline, estimates = run.score()["last_40_percent"].model, list(run.estimates)
    _, player = fly(flight, sim_time=True)
    costs = []
    for speed in SPEEDS:
        player.outputs.clear()
        # a restart of the recording: the node starts cold
        player.play(flight.messages, speed=speed, in_step=True)
        outputs = player.outputs
        assert len(outputs.named) == len(outputs.coefficients)
        live = {
            header_ns(named): np.array(dense.data).reshape(run.structure.mask.shape)
            for named, dense in zip(outputs.named, outputs.coefficients, strict=True)
        }
        assert live.keys() >= {e.t_ns for e in estimates}
        run.estimates = Ticks(
            run.structure, [replace(e, coefficients=live[e.t_ns]) for e in estimates]
        )
        costs.append(np.abs(run.score()["last_40_percent"].model - offline).max())
        if costs[-1] < 1.0:
            return
    pytest.fail(f"the fit differs by {costs} points")
