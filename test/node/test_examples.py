# SPDX-License-Identifier: Apache-2.0
"""The examples run, with the printed or drawn results of a replay or a node."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from excerpts import parameter_file, written
from geometry_msgs.msg import TwistStamped
from programs import PATIENCE, Capture, python
from rclpy.serialization import deserialize_message, serialize_message
from recordings import RATES_TOPIC, Fly, Player, Recording, estimates, recording
from repository import ROOT
from sensor_msgs.msg import Imu

from uav_ident_ros.commandline import NOT_USABLE, USABLE
from uav_ident_ros.guest import Guest
from uav_ident_ros.process import own_domain
from uav_ident_ros.simulation import closed_loop
from uav_ident_ros.simulation.preparation import prepare

EXAMPLES = ROOT / "examples"


def command(name: str, *arguments: str) -> list[str]:
    return [sys.executable, str(EXAMPLES / name), *arguments]


def run(name: str, *arguments: str) -> str:
    done = python(*command(name, *arguments)[1:])
    assert done.returncode == 0, done.stderr
    return done.stdout


@contextmanager
def running(
    name: str, *arguments: str, stderr: int | None = None, **environment: str
) -> Iterator[subprocess.Popen[str]]:
    """Run an example beside the test, which ends it."""
    own = {**os.environ, **environment}
    with subprocess.Popen(command(name, *arguments), stderr=stderr, text=True, env=own) as process:
        try:
            yield process
        finally:
            process.kill()


def test_every_example_is_listed() -> None:
    listed = re.findall(r"^\| `([\w.]+)` \|", (EXAMPLES / "README.md").read_text(), re.MULTILINE)
    shipped = [path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".yaml")]
    assert sorted(listed) == sorted(shipped)


@pytest.mark.parametrize(
    "name", ["indi.py", "inversion.py", "lqr.py", "effectiveness_monitor.py", "live_plot.py"]
)
def test_an_example_ends_on_ctrl_c_without_a_traceback(name: str) -> None:
    nominal = ROOT / "config" / "closed_loop" / "c172p_coefficients.yaml"
    controls = name in ("indi.py", "inversion.py", "lqr.py")
    arguments = ("--ros-args", "-p", f"nominal_file:={nominal}") if controls else ()
    with running(name, *arguments, stderr=subprocess.PIPE, MPLBACKEND="agg") as process:
        node = name.removesuffix(".py")
        with closing(Guest("observer")) as guest:
            nodes = guest.node.get_node_names
            assert guest.spin_for(PATIENCE, lambda: node in nodes() or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE)
        assert (process.returncode, errors) == (0, "")
    if controls:
        assert "no coefficients file is named: give the path" in python(*command(name)[1:]).stderr


def test_fleet_table_reads_the_results_of_a_replay(replayed_example: Path) -> None:
    header, row = run("fleet_table.py", str(replayed_example.parent)).splitlines()
    shown = "pdot/p pdot/da qdot/q qdot/de rdot/r rdot/dr"
    assert header.split() == ["flight", "verdict", *shown.split()]
    assert row.startswith("c172p           usable ")


def test_live_plot_and_read_coefficients_follow_a_running_node(fly: Fly, tmp_path: Path) -> None:
    flight = recording("multisine", 60.0)
    _, player = fly(flight)
    picture = tmp_path / "live.png"
    with running("live_plot.py", "--save", str(picture), "--seconds", "3") as plot:
        topic = "/identifier/coefficients_named"
        player.wait_until(lambda: player.node.count_subscribers(topic) == 2, "live_plot")
        # a counted subscriber may not be connected: play until the plot has enough messages
        for second in range(60):
            if plot.poll() is None:
                player.play_in_step(flight.part(second, second + 1))
        assert plot.wait(PATIENCE) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    # latched: a late subscriber receives the last message
    lines = run("read_coefficients.py", "--once").splitlines()
    assert re.fullmatch(r"\d+ s: (not )?usable", lines[0])
    assert any(re.fullmatch(r"pdot/da +[+-]?\d+\.\d+ ± \d+\.\d+", line) for line in lines)


TWIST = "geometry_msgs/msg/TwistStamped"


def with_rates(flight: Recording, kind: str, make: Callable[[Imu], object]) -> Recording:
    """Return a recording with other messages on the topic of the rates."""
    messages = [
        m._replace(data=serialize_message(make(deserialize_message(m.data, Imu))))
        if m.topic == RATES_TOPIC
        else m
        for m in flight.messages
    ]
    return replace(flight, messages=messages, types={**flight.types, RATES_TOPIC: kind})


def twist(imu: Imu) -> TwistStamped:
    message = TwistStamped(header=imu.header)
    message.twist.angular = imu.angular_velocity
    return message


def without_force(imu: Imu) -> Imu:
    imu.linear_acceleration_covariance[0] = -1.0
    return imu


def test_a_message_type_of_the_author_gives_the_estimates_of_an_imu(tmp_path: Path) -> None:
    """In the node over DDS, and in a replay, to the bit."""
    flight = recording("c172p", 3.5)
    twists = with_rates(flight, TWIST, twist)
    own = parameter_file(tmp_path / "own.yaml", imu__type=TWIST)
    files = ("--params-file", str(flight.parameter_file), "--params-file", str(own))
    arguments = ("identifier", "--ros-args", *files)
    with running("own_message.py", *arguments, ROS_HOME=str(tmp_path)) as node:
        with closing(Player(twists.classes, clock=False)) as player:
            player.wait_for_node()
            player.play_in_step(twists.messages)
            found = player.ticks()
        node.send_signal(signal.SIGINT)
        assert node.wait(PATIENCE) == 0
    expected = with_rates(flight, flight.types[RATES_TOPIC], without_force).replayed(tmp_path)
    assert len(expected) > 50 and found == expected
    bag = written(tmp_path / "twists", twists.types, twists.messages)
    output = tmp_path / "output"
    arguments = ("replay", str(bag), *files, "--output", str(output))
    done = python(*command("own_message.py", *arguments)[1:])
    assert done.returncode in (USABLE, NOT_USABLE), done.stderr
    assert estimates(output) == expected


def test_an_aircraft_of_the_author_flies_in_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    pytest.importorskip("jsbsim", reason="JSBSim is a development extra")
    monkeypatch.setattr(closed_loop, "PREPARED", tmp_path / "prepared")
    monkeypatch.setattr(closed_loop, "prepare", partial(prepare, time=20.0))
    monkeypatch.chdir(ROOT)
    arguments = ["--aircraft", "examples/own_aircraft.yaml", "--duration", "4"]
    with own_domain():
        assert closed_loop.main([*arguments, "--output", str(tmp_path)]) == 0
    assert "identifying own_aircraft at 90.0 m/s: turboprop trainer" in capsys.readouterr().out
    with np.load(tmp_path / "flight.npz") as archive:
        record = dict(archive)
    assert record["usable"].any()
    assert closed_loop.tracking_error(record, 2.0, 4.0).max() < 5.0
