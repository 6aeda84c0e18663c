# SPDX-License-Identifier: Apache-2.0
"""The node under test: its own process, its own ROS domain, its own log folder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from node_process import NodeProcess, StartNode
from recordings import MakePlayer, Recording

from uav_ident_ros.player import Player

HIGHEST_DOMAIN = 101
"""Highest ROS domain whose ports are free of the system's ephemeral ones."""


@pytest.fixture(scope="session", autouse=True)
def ros_environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep this session's traffic, logs and saved files to itself."""
    environment = {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % HIGHEST_DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("log")),
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield


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
