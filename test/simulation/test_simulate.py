# SPDX-License-Identifier: Apache-2.0
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from programs import Capture, refusal
from rosbags.highlevel import AnyReader

from uav_ident_ros.simulation.cli import main

BAGS = Path(__file__).resolve().parents[2] / "bags"
ROW = re.compile(r"^\| `(\w+)` \|.*`simulate ([^`]+)` \|$", re.MULTILINE)
COMMANDS = dict(ROW.findall((BAGS / "README.md").read_text(encoding="utf-8")))


def numbers(path: Path, every: int = 1) -> dict[str, np.ndarray]:
    """Log times of all messages; log time, stamp and values of one in so many, by topic."""
    rows: dict[str, list[list[float]]] = {}
    times: list[int] = []
    with AnyReader([path]) as reader:
        for connection, t, raw in reader.messages():
            times.append(t)
            if len(times) % every:
                continue
            message = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype == "sensor_msgs/msg/Imu":
                rate, force = message.angular_velocity, message.linear_acceleration
                values = [rate.x, rate.y, rate.z, force.x, force.y, force.z]
            elif connection.msgtype == "sensor_msgs/msg/JointState":
                values = list(message.position)
            else:
                values = list(message.data)
            if hasattr(message, "header"):
                values += [message.header.stamp.sec, message.header.stamp.nanosec]
            rows.setdefault(connection.topic, []).append([t - 1_700_000_000 * 10**9, *values])
    return {"times": np.array(times)} | {k: np.array(values) for k, values in rows.items()}


def test_every_committed_bag_has_its_command() -> None:
    assert set(COMMANDS) == {p.name for p in BAGS.iterdir() if p.is_dir()}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_makes_the_committed_bag(tmp_path: Path, name: str) -> None:
    arguments = shlex.split(COMMANDS[name])
    if "--jsbsim" in arguments:
        pytest.importorskip("jsbsim", reason="JSBSim is a development extra")
    assert arguments[:2] == ["--output", f"bags/{name}"]
    assert main(["--output", str(tmp_path / name), *arguments[2:]]) == 0
    # a flight that differs at all differs from then on: one message in seven is decoded
    made, committed = (numbers(folder / name, every=7) for folder in (tmp_path, BAGS))
    assert made.keys() == committed.keys() == {"times", "/imu/data", "/actuators"}
    for topic, values in committed.items():
        # not to the bit: another processor's sine may differ in the last one
        np.testing.assert_allclose(made[topic], values, rtol=0.0, atol=1e-6, err_msg=topic)
    for file in ("identifier.yaml", "truth.yaml"):
        assert yaml.safe_load((tmp_path / name / file).read_text()) == yaml.safe_load(
            (BAGS / name / file).read_text()
        )


def test_options_reach_the_bag(tmp_path: Path) -> None:
    arguments = "--duration 3 --imu-rate 50 --convention frd --unstamped --channels elevon"
    assert main(["--output", str(tmp_path / "bag"), *arguments.split(), "--delay", "0.06"]) == 0
    found = numbers(tmp_path / "bag")
    assert len(found["/imu/data"]) == 151
    assert found["/imu/data"][:, 6].mean() == pytest.approx(-9.8, abs=0.5)
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
        ("--duration -3", "duration"),
        ("--delay nan", "delay"),
        ("--delay 0.0101234", "delay"),
        ("--amplitude nan 0 0 0", "--amplitude"),
        ("--amplitude 9999 9999 9999 0", "diverges"),
        ("--bank 20", "--bank"),
        ("--jsbsim c172p --gusts 1", "--gusts"),
        ("--jsbsim ufo", "c172p"),
        ("--plant small_uav --jsbsim c172p", "--jsbsim"),
        ("--input sweep", "sweep"),
        ("--seed -1", "--seed"),
    ],
)
def test_bad_arguments_are_one_line_and_status_2(
    tmp_path: Path, capsys: Capture, options: str, named: str
) -> None:
    arguments = ["--output", str(tmp_path / "bag"), *options.split()]
    assert named in refusal(main, arguments, capsys)
    assert not (tmp_path / "bag").exists()


def test_an_existing_folder_is_refused(tmp_path: Path, capsys: Capture) -> None:
    assert "exists already" in refusal(main, ["--output", str(tmp_path)], capsys)
