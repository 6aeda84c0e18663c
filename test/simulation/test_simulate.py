# SPDX-License-Identifier: Apache-2.0
import re
import shlex
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from excerpts import BAGS, decoded
from programs import Capture, refusal

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.simulation.cli import main

ROW = re.compile(r"^\| `(\w+)` \|.*`simulate ([^`]+)` \|$", re.MULTILINE)
COMMANDS = dict(ROW.findall((BAGS / "README.md").read_text(encoding="utf-8")))


def flat(value: Any) -> list[float]:
    """Return all numbers of a message, in the order of its fields."""
    if is_dataclass(value):
        return [x for field in fields(value) for x in flat(getattr(value, field.name))]
    return [] if isinstance(value, str | list) else np.ravel(value).tolist()


def numbers(path: Path) -> dict[str, np.ndarray]:
    """Return all log times, and the numbers of every seventh message, by topic.

    A deviation persists, so a part of the messages suffices.
    """
    with Bag(path) as bag:
        decoders = {topic: bag.decoder(topic) for topic in bag.types}
        messages = list(bag.messages(decoders))
        rows: dict[str, list[list[float]]] = {"times": [[m.log_ns] for m in messages]}
        for topic, _, data in messages[::7]:
            rows.setdefault(topic, []).append(flat(decoders[topic](data)))
    return {topic: np.array(values) for topic, values in rows.items()}


def test_every_committed_bag_has_its_command() -> None:
    assert set(COMMANDS) == {p.name for p in BAGS.iterdir() if p.is_dir()}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_reproduces_the_committed_bag(tmp_path: Path, name: str) -> None:
    arguments = shlex.split(COMMANDS[name])
    if "--jsbsim" in arguments:
        pytest.importorskip("jsbsim", reason="JSBSim is a development extra")
    assert arguments[:2] == ["--output", f"bags/{name}"]
    assert main(["--output", str(tmp_path / name), *arguments[2:]]) == 0
    made, committed = (numbers(folder / name) for folder in (tmp_path, BAGS))
    assert made.keys() == committed.keys() == {"times", "/imu/data", "/actuators"}
    for topic, values in committed.items():
        # not to the bit: the sine may differ in the last bit on another processor
        np.testing.assert_allclose(made[topic], values, rtol=0.0, atol=1e-6, err_msg=topic)
    for file in ("identifier.yaml", "truth.yaml"):
        assert yaml.safe_load((tmp_path / name / file).read_text()) == yaml.safe_load(
            (BAGS / name / file).read_text()
        )


def test_options_apply_to_the_bag_and_its_parameters(tmp_path: Path) -> None:
    arguments = "--duration 3 --imu-rate 50 --convention frd --unstamped --channels elevon"
    assert main(["--output", str(tmp_path / "bag"), *arguments.split(), "--delay", "0.06"]) == 0
    force = [m.linear_acceleration.z for _, m in decoded(tmp_path / "bag")["/imu/data"]]
    assert len(force) == 151
    assert np.mean(force) == pytest.approx(-9.8, abs=0.5)
    content = yaml.safe_load((tmp_path / "bag" / "identifier.yaml").read_text())
    parameters = content["/**"]["ros__parameters"]
    assert parameters["actuators.delay"] == 0.06
    assert parameters["actuators.type"] == "std_msgs/msg/Float64MultiArray"
    assert parameters["actuators.mixing.da"] == [0.5, -0.5, 0.0, 0.0]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("--imu-rat 10", "--imu-rat"),
        ("--imu-rate 0", "--imu-rate"),
        ("--imu-rate nan", "--imu-rate"),
        ("--noise -1", "gyro_noise"),
        ("--amplitude nan 0 0 0", "--amplitude"),
        ("--delay 1000", "--delay is 1000: 0 to 0.5 s"),
        ("--bank 20", "--bank"),
        ("--airspeed-noise 0", "--airspeed-noise belongs to an aircraft"),
        ("--jsbsim c172p --gusts 1", "--gusts"),
        ("--plant small_uav --jsbsim c172p", "--jsbsim"),
        ("--input sweep", "sweep"),
        ("--seed -1", "--seed"),
    ],
)
def test_bad_arguments_are_refused_in_one_line_with_status_2(
    tmp_path: Path, capsys: Capture, options: str, named: str
) -> None:
    arguments = ["--output", str(tmp_path / "bag"), *options.split()]
    assert named in refusal(main, arguments, capsys)
    assert not (tmp_path / "bag").exists()


def test_an_existing_folder_is_refused(tmp_path: Path, capsys: Capture) -> None:
    assert "exists already" in refusal(main, ["--output", str(tmp_path)], capsys)
