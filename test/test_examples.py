# SPDX-License-Identifier: Apache-2.0
"""The examples run on a linear aircraft, by direct calls of the nodes' callbacks."""

import importlib.util
import re
import runpy
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the examples are ROS nodes")

import rclpy
from estimates import as_message, estimate_of
from excerpts import BAGS, excerpt
from geometry_msgs.msg import Vector3, Vector3Stamped
from plants import DT_NS, START, STRUCTURE, a_sample_later, coefficients, flown
from programs import Capture
from sensor_msgs.msg import Imu, JointState

from uav_ident_ros.client import AttitudeModel, Coefficients
from uav_ident_ros.files.coefficients_file import save_coefficients
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.prior import first_values
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.messages.types import RATE_ADAPTERS

FOLDER = Path(__file__).parents[1] / "examples"
REFERENCE = np.array([0.2, 0.05, 0.03])


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[None]:
    healthy, path = coefficients(), tmp_path / "nominal.yaml"
    save_coefficients(CoefficientSet(STRUCTURE.name, healthy.values, healthy.sigma), path)
    rclpy.init(args=["--ros-args", "-p", f"nominal_file:={path}"])
    yield
    rclpy.shutdown()


@pytest.fixture(autouse=True)
def tables() -> Iterator[None]:
    """Take back what the examples enter."""
    tables: tuple[dict[str, Any], ...] = (STRUCTURES, RATE_ADAPTERS)
    before = [dict(table) for table in tables]
    yield
    for table, entries in zip(tables, before, strict=True):
        table.clear()
        table.update(entries)


class Flying:
    """Stand-in for a controller's node; collects its publications."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.callbacks = {topic.topic_name: topic.callback for topic in node.subscriptions}
        (commands,) = [topic for topic in node.publishers if topic.topic_name == "/command"]
        commands.publish = self.publish

    def publish(self, message: JointState) -> None:
        assert list(message.name) == ["elevator", "rudder", "aileron"]
        self.u = np.append(message.position, 0.0)

    def update(self, t_ns: int, x: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        p, q, r = wanted.tolist()
        self.callbacks["/rate_reference"](Vector3Stamped(vector=Vector3(x=p, y=q, z=r)))
        self.callbacks["/imu/data"](sample(t_ns, x))
        return self.u


def sample(t_ns: int, x: np.ndarray) -> Imu:
    message = Imu()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    w = message.angular_velocity
    w.x, w.y, w.z = float(x[0]), -float(x[1]), -float(x[2])  # FLU
    return message


@pytest.mark.parametrize(
    ("name", "node", "error"),
    [("indi", "Indi", 0.01), ("inversion", "Inversion", 0.01), ("lqr", "Lqr", 0.1)],
)
def test_each_controller_follows_a_reference(ros: None, name: str, node: str, error: float) -> None:
    """A regulator without integral action has a steady-state error."""
    flying = Flying(getattr(load(name), node)())
    flying.node.source.add(coefficients())  # includes the flow angles
    np.testing.assert_allclose(flown(flying, reference=REFERENCE)[-1], REFERENCE, atol=error)
    held = flying.u
    assert flying.update(START, np.array([np.nan, 0.0, 0.0]), REFERENCE) is held
    flying.node.destroy_node()


def test_the_gain_solves_the_riccati_equation() -> None:
    linalg = pytest.importorskip("scipy.linalg")
    lqr = load("lqr")
    a = np.array([[-6.4, 0.0, 1.4], [0.0, -5.5, 0.0], [-0.3, 0.0, -0.5]])
    b = np.array([[0.0, 3.0, 29.5], [-26.0, 0.0, 0.0], [0.0, -4.3, -0.2]])
    q, r = lqr.STATE_WEIGHT, lqr.INPUT_WEIGHT
    gain = lqr.lqr_gain(a, b, q, r)
    both = linalg.expm(np.block([[a, b], [np.zeros((3, 6))]]) * lqr.STEP)
    f, g = both[:3, :3], both[:3, 3:]
    p = linalg.solve_discrete_are(f, g, q * lqr.STEP, r * lqr.STEP)
    expected = np.linalg.solve(r * lqr.STEP + g.T @ p @ g, g.T @ p @ f)
    np.testing.assert_allclose(gain, expected, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize(("effect", "words"), [(1.0, []), (0.2, ["roll: the inputs do 0."])])
def test_the_monitor_warns_of_a_weak_aileron_alone(
    ros: None, effect: float, words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = load("effectiveness_monitor")
    node = module.EffectivenessMonitor()
    plant, x = coefficients(np.array([1.0, 1.0, effect, 1.0])).values, np.zeros(3)
    rng = np.random.default_rng(0)
    for k in range(800):
        t_ns, t = START + k * DT_NS, 0.01 * k
        node.source.add(coefficients(1.0, t_ns))
        u = [0.02 * np.sin(3.0 * t), 0.03 * np.sin(2.0 * t), 0.02 * np.sin(4.0 * t), 0.0]
        node.on_actuators(JointState(position=u))
        node.on_imu(sample(t_ns, x + 0.002 * rng.standard_normal(3)))
        x = a_sample_later(x, np.array(u), plant)
    printed: list[str] = []
    monkeypatch.setattr(node.get_logger(), "warning", printed.append)
    node.warn()
    assert [line[: len(word)] for line, word in zip(printed, words, strict=True)] == words
    node.destroy_node()


def test_the_prediction_from_a_message_equals_that_of_the_client() -> None:
    flight = STRUCTURES["flight_dynamics"]
    rng = np.random.default_rng(3)
    a = first_values(flight) + flight.mask * rng.normal(0.0, 2.0, flight.mask.shape)
    flow = FlowState(0.05, 0.08, 0.0, 0.0, roll=0.4, pitch=-0.2, airspeed=23.0)
    given = estimate_of(a, 0.01 * np.abs(a), t_ns=START, flow=flow)
    made = as_message(given, flight)
    message = JointState(name=made.name, position=made.position, effort=made.effort)
    rates, u = [0.3, -0.1, 0.2], [0.05, -0.03, 0.1, 0.2]
    read = Coefficients.from_message(message)
    model = AttitudeModel(read.structure, read.values, read.structure.mask, read.flow)
    x = np.array([*rates, flow.beta, flow.alpha])
    found = load("predict_from_message").predict(message, rates, u, 1.0)
    np.testing.assert_allclose(found, model.predict(x, np.array(u), 1.0), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["own_estimator", "own_gate", "own_message", "own_regressor"])
def test_an_example_without_its_bag_prints_its_usage(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(sys, "argv", [name])
    with pytest.raises(SystemExit):
        runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    assert capsys.readouterr().err.startswith("usage: ")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("own_estimator", r"own: largest step of pdot/da (\S+) .*\nwithout: .* pdot/da (\S+) "),
        ("own_gate", r"own: .*'load': '(\d+)%'.*\nwithout: (?!.*load)"),
        (
            "own_regressor",
            r"pdot/da\|da\| is \S+ \+- (\S+), a t-ratio of [\d.]+\nflight_dynamics: ",
        ),
    ],
)
def test_parts_of_the_author_take_effect(
    name: str, words: str, tmp_path: Path, capsys: Capture
) -> None:
    bag = excerpt(tmp_path / "bag", 8.0, "c172p")
    shutil.copy(BAGS / "c172p" / "identifier.yaml", bag)
    load(name).main(bag)
    found = re.search(words, capsys.readouterr().out)
    assert found is not None
    own, *without = map(float, found.groups())
    assert own > 0.0
    assert not without or own < 0.9 * without[0]
