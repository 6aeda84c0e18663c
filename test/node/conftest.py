# SPDX-License-Identifier: Apache-2.0
"""The node under test: its own process, its own saved coefficients."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from node_process import NodeProcess, StartNode
from recordings import MakePlayer, Recording

from uav_ident_ros.player import Player


@pytest.fixture
def ros_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the nodes of one test keep their coefficients: none starts from another test's."""
    home = tmp_path / "ros_home"
    monkeypatch.setenv("ROS_HOME", str(home))
    return home


@pytest.fixture
def start_node(ros_home: Path) -> Iterator[StartNode]:
    """Start the node; it is ended after the test."""
    started: list[NodeProcess] = []

    def start(
        *arguments: str,
        parameter_file: Path | None = None,
        parameters: Mapping[str, str] | None = None,
        sim_time: bool = False,
    ) -> NodeProcess:
        ros = ["--ros-args"]
        if parameter_file is not None:
            ros += ["--params-file", str(parameter_file)]
        for name, value in {**(parameters or {})}.items():
            ros += ["-p", f"{name}:={value}"]
        if sim_time:
            ros += ["-p", "use_sim_time:=true"]
        node = NodeProcess([*ros, *arguments])
        started.append(node)
        return node

    yield start
    for node in started:
        print(node.log)  # pytest shows it if the test failed
        node.kill()


@pytest.fixture
def make_player() -> Iterator[MakePlayer]:
    """Make a player for a recording; it leaves the graph after the test."""
    made: list[Player] = []

    def make(flight: Recording, **options: object) -> Player:
        made.append(Player(flight.classes, **options))
        return made[-1]

    yield make
    for player in made:
        player.close()
