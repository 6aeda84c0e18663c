# SPDX-License-Identifier: Apache-2.0
"""The node under test: a separate process, separate saved coefficients, and a player."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from programs import StartNode
from recordings import Fly, Player, Recording

from uav_ident_ros.process import NodeProcess, own_domain


@contextmanager
def starting(home: Path) -> Iterator[StartNode]:
    """Start nodes in a separate domain, with their coefficients in `home`; end them all."""
    started: list[NodeProcess] = []

    def start(parameters: Mapping[str, object] | None = None, **options: Any) -> NodeProcess:
        log, values = Path(logs) / f"{len(started)}.log", parameters or {}
        started.append(NodeProcess("uav_ident_ros.node", log, values, home=home, **options))
        return started[-1]

    with TemporaryDirectory() as logs, own_domain():
        yield start
        for node in started:
            print(node.log)  # pytest shows it if the test failed
            node.end()


@contextmanager
def flying(home: Path) -> Iterator[Fly]:
    """Start nodes, each with a player of its inputs."""
    with starting(home) as start, ExitStack() as players:

        def fly(
            flight: Recording,
            *,
            sim_time: bool = False,
            parameters: Mapping[str, object] | None = None,
        ) -> tuple[NodeProcess, Player]:
            values = {**(parameters or {}), "use_sim_time": sim_time}
            node = start(values, file=flight.parameter_file)
            player = Player(flight.classes, clock=sim_time)
            players.callback(player.close)
            player.wait_for_node()
            return node, player

        yield fly


@pytest.fixture
def ros_home(tmp_path: Path) -> Path:
    """Return the folder of one test's saved coefficients: no test starts from another's."""
    return tmp_path / "ros_home"


@pytest.fixture
def start_node(ros_home: Path) -> Iterator[StartNode]:
    """Start a node; end it after the test."""
    with starting(ros_home) as start:
        yield start


@pytest.fixture
def fly(ros_home: Path) -> Iterator[Fly]:
    """Start a node with the parameters of a recording, and a player."""
    with flying(ros_home) as start:
        yield start


@pytest.fixture(scope="module")
def shared_fly(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fly]:
    """Start a node and a player for all tests of a file."""
    with flying(tmp_path_factory.mktemp("shared")) as start:
        yield start
