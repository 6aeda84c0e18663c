# SPDX-License-Identifier: Apache-2.0
"""The launch files: arguments, nodes and order, with `ros2 launch` where available.

All but the last tests run without launch, which is not on PyPI.
"""

import importlib
import re
import runpy
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from repository import ROOT, Made, console_scripts, launch_arguments, launch_entries, read_arguments

from uav_ident_ros.client import Coefficients
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.simulation import closed_loop

PACKAGE = "uav_ident_ros"
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
EACH = pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
PROCESSES = ("Node", "ExecuteProcess")


def nodes(made: list[Made]) -> list[dict[str, Any]]:
    return [m.named for m in made if m.kind == "Node"]


def launch_file(name: str) -> list[Made]:
    return launch_entries(ROOT / "launch" / f"{name}.launch.py")


@EACH
def test_arguments_are_declared_described_and_used(path: Path) -> None:
    made = launch_entries(path)
    declared = [m.args[0] for m in launch_arguments(made)]
    assert sorted(declared) == sorted(read_arguments(made))
    assert {"params_file", "namespace", "log_level"} <= read_arguments(made)
    assert all(m.named["description"] for m in launch_arguments(made))


@pytest.mark.parametrize("name", ["identifier", "replay"])
def test_every_input_can_be_renamed(name: str) -> None:
    made = launch_file(name)
    (node,) = nodes(made)
    arguments = {topic: value.args[0] for topic, value in node["remappings"]}
    assert set(arguments) == {stream.topic for stream in STREAMS}
    defaults = {m.args[0]: m.named.get("default_value") for m in launch_arguments(made)}
    # a bag's topics do not follow the node's namespace
    before = "/" if name == "replay" else ""
    assert all(defaults[argument] == before + topic for topic, argument in arguments.items())
    assert node["executable"] in console_scripts() and node["package"] == PACKAGE
    *_, file = defaults["params_file"].args[0]
    assert file == "identifier.yaml"  # the defaults, not the values of a vehicle or the paper
    assert (ROOT / "config" / file).is_file()


@EACH
def test_files_are_checked_before_the_start_and_every_exit_is_handled(path: Path) -> None:
    """A process started before an error would keep running."""
    made = launch_entries(path)
    kinds = [m.kind for m in made]
    first = min(k for k, kind in enumerate(kinds) if kind in PROCESSES)
    watched = [m.args[0].named for m in made[:first] if m.kind == "RegisterEventHandler"]
    judges = [w["on_exit"] for w in watched if callable(w["on_exit"])]
    processes = [m for m in made if m.kind in PROCESSES]
    assert [w["target_action"] for w in watched if callable(w["on_exit"])] == processes
    assert "OpaqueFunction" not in kinds[first:]

    check = made[kinds.index("OpaqueFunction")].named["function"]
    context = dict.fromkeys(read_arguments(made), str(path))
    check(context)
    with pytest.raises(Exception, match=r"params_file 'none\.yaml': there is no such file"):
        check(context | {"params_file": "none.yaml"})

    class Context(dict[str, str]):
        is_shutdown = False

    def end(status: int, respawn: str = "false") -> None:
        ended = SimpleNamespace(process_name="identifier", returncode=status)
        judges[0](ended, Context(respawn=respawn))

    end(0)
    with pytest.raises(Exception, match="'identifier' ended with status -9"):
        end(-9)
    if path.name == "identifier.launch.py":
        end(-9, "true")  # the process is restarted
        with pytest.raises(Exception, match="status 2"):
            end(2, "true")  # wrong parameters: a restart is useless


def test_a_bag_is_played_on_its_own_clock_and_the_nodes_topics_are_recorded() -> None:
    recorder, player = (m.named["cmd"] for m in launch_file("replay") if m.kind == "ExecuteProcess")
    for command in (recorder, player):
        assert (command[0].named, command[1]) == ({"name": "ros2"}, "bag")
    pattern = recorder[-1]
    for topic in ("/identifier/coefficients_named", "/drone1/identifier/coefficients"):
        assert re.search(pattern, topic)
    assert re.search(pattern, "/diagnostics")
    for topic in ("/imu/data", "/clock", "/rosout", "/other/diagnostics_agg"):
        assert not re.search(pattern, topic)
    words = [word.args[0] if isinstance(word, Made) and word.args else word for word in player[1:]]
    # an option without a value would consume the next argument
    assert words[:5] == ["bag", "play", "bag", "--clock", "clock_rate"]
    (node,) = nodes(launch_file("replay"))
    assert node["parameters"][1] == {"use_sim_time": True, "state_file": "none"}


def test_the_closed_loop_starts_existing_nodes_with_parameter_sections() -> None:
    made = launch_file("closed_loop")
    started = {node["executable"]: node for node in nodes(made)}
    assert set(started) <= set(console_scripts())
    names = {node["name"] for node in started.values()}
    assert names == set(closed_loop.MODULES)
    # launch_ros joins the pieces, reads the text as YAML, and needs exactly the type
    faults = started["simulated_plant"]["parameters"][1]["faults"]
    assert faults.named["value_type"] == list[str]
    for fault in ("", "60: aileron effect 0.5"):
        text = "".join(fault if isinstance(piece, Made) else piece for piece in faults.args[0])
        assert yaml.safe_load(text) == [fault]
    paths = {
        m.args[0]: ROOT.joinpath(*m.named["default_value"].args[0][1:])
        for m in launch_arguments(made)
        if m.args[0] in ("params_file", "coefficients_file")
    }
    sections = yaml.safe_load(paths["params_file"].read_text())
    # a node refuses a file without a section of it
    assert {key.rpartition("/")[2] for key in sections} == names
    assert Coefficients.from_file(paths["coefficients_file"]).known.any()


# --- with launch --------------------------------------------------------------------------------


@EACH
def test_launch_description_builds(path: Path) -> None:
    # not "launch": with `python -m pytest` that is the folder of the launch files
    pytest.importorskip("launch.actions", reason="launch comes with apt ROS only")
    launch = importlib.import_module("launch")
    description = runpy.run_path(str(path))["generate_launch_description"]()
    assert isinstance(description, launch.LaunchDescription)
    assert "params_file" in {argument.name for argument in description.get_launch_arguments()}


def launched(path: Path, *arguments: str) -> str:
    """Return the output of a launch that ends with status 1; skip if `ros2` lacks this package."""
    known = ["ros2", "pkg", "prefix", PACKAGE]
    if shutil.which("ros2") is None or subprocess.run(known, capture_output=True).returncode:
        pytest.skip("there is no ros2 with this package here")
    command = ["ros2", "launch", PACKAGE, path.name, *arguments]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300.0)
    assert run.returncode == 1
    return run.stdout + run.stderr


@EACH
def test_launch_ends_with_an_error_without_its_parameter_file(path: Path, tmp_path: Path) -> None:
    """launch_ros only warns, and starts the node with its defaults."""
    bag = [f"bag:={tmp_path}"] if path.name == "replay.launch.py" else []
    printed = launched(path, f"params_file:={tmp_path / 'none.yaml'}", *bag)
    assert f"params_file '{tmp_path / 'none.yaml'}': there is no such file" in printed
    assert "process started" not in printed


def test_launch_ends_with_an_error_when_the_identifier_ends(tmp_path: Path) -> None:
    """The identifier refuses the file with status 2; launch has a separate error status."""
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("/uav_ident:\n  ros__parameters:\n    update_rate: 10.0\n")
    path = ROOT / "launch" / "identifier.launch.py"
    assert "ended with status 2" in launched(path, f"params_file:={wrong}")
