# SPDX-License-Identifier: Apache-2.0
"""Mistakes at the start: each is named by the log and on /diagnostics, with what to do."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3
from node_process import StartNode, wait_for
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState, MagneticField
from std_msgs.msg import Float64MultiArray

from uav_ident_ros.node.diagnostics import TickMeter
from uav_ident_ros.node.graph import Wanted, namesakes, why_silent

IMU = "sensor_msgs/msg/Imu"
TYPES = (IMU, "px4_msgs/msg/SensorCombined")
ARRAY = "std_msgs/msg/Float64MultiArray"
QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
START_NS = 1_700_000_000_000_000_000
PERIOD = 0.01


@pytest.fixture
def graph() -> Iterator[tuple[Node, Node]]:
    """A node that listens and one that publishes."""
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes = [rclpy.create_node(name, context=context) for name in ("listener", "driver")]
    yield nodes[0], nodes[1]
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def wanted(name: str = "imu/data", type_name: str = IMU) -> Wanted:
    types = TYPES if type_name == IMU else (ARRAY, "sensor_msgs/msg/JointState")
    parameter = "imu.type" if type_name == IMU else "actuators.type"
    return Wanted(name, f"/{name}", type_name, parameter, types)


def says(node: Node, input_: Wanted, words: str) -> bool:
    return wait_for(lambda: words in why_silent(node, input_))


def test_nobody_publishes_it_and_nothing_fits(graph: tuple[Node, Node]) -> None:
    listener, _ = graph
    said = why_silent(listener, wanted())
    assert said.startswith("nobody publishes '/imu/data': no other topic fits")
    assert "ROS_DOMAIN_ID" in said


def test_the_nearest_topic_of_the_type_is_named(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    for topic in ("/imu/data_raw", "/gimbal/orientation"):
        driver.create_publisher(Imu, topic, QOS)
    assert says(listener, wanted(), f"'/imu/data_raw' carries {IMU}: start with -r imu/data:=/imu")


def test_a_topic_of_another_type_that_fits_is_named(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    driver.create_publisher(JointState, "/servos", QOS)
    words = "-r actuators:=/servos -p actuators.type:=sensor_msgs/msg/JointState"
    assert says(listener, wanted("actuators", ARRAY), words)


def test_outputs_of_an_identifier_are_no_inputs(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    driver.create_publisher(JointState, "/other/identifier/coefficients_named", QOS)
    driver.create_publisher(Float64MultiArray, "/other/identifier/coefficients", QOS)
    assert wait_for(lambda: listener.count_publishers("/other/identifier/coefficients") > 0)
    assert "no other topic fits" in why_silent(listener, wanted("actuators", ARRAY))


def test_another_type_on_the_topic_names_the_parameter(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    driver.create_publisher(JointState, "/actuators", QOS)
    words = "set 'actuators.type' to sensor_msgs/msg/JointState"
    assert says(listener, wanted("actuators", ARRAY), words)
    assert "'/actuators' of /driver carries" in why_silent(listener, wanted("actuators", ARRAY))


def test_a_type_that_is_of_no_use_names_it(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    driver.create_publisher(MagneticField, "/imu/data", QOS)
    assert says(listener, wanted(), "carries sensor_msgs/msg/MagneticField, but")
    assert "set 'imu.type'" not in why_silent(listener, wanted())


def test_qos_that_does_not_fit_names_the_override(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    driver.create_publisher(Imu, "/imu/data", QOS)
    listener.create_subscription(Imu, "/imu/data", lambda _: None, 10)  # reliable
    words = "'qos_overrides./imu/data.subscription.reliability' asks for reliable"
    assert says(listener, wanted(), words)


def test_a_publisher_that_sends_nothing_is_named(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    driver.create_publisher(Imu, "/imu/data", QOS)
    assert says(listener, wanted(), "'/imu/data' has a publisher, /driver, which sends nothing")


def test_nodes_of_one_name_are_counted(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    assert namesakes(listener) == 1
    twin = rclpy.create_node("listener", context=driver.context)
    assert wait_for(lambda: namesakes(listener) == 2)
    twin.destroy_node()


def test_a_node_that_was_held_up_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    meter = TickMeter(0.05)
    for interval in (0.05, 1.4, 0.05):
        meter.called()
        assert meter.held_up() == pytest.approx(0.0 if now < 101.0 else 1.4)
        now += interval
    now += 10.0
    assert meter.held_up() == 0.0


# --- through the node --------------------------------------------------------------------------


class Source:
    """Publishes an Imu and actuators, right or with a mistake, and hears /diagnostics."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("source", context=self.context)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.imu = self.node.create_publisher(Imu, "/imu/data", QOS)
        self.actuators = self.node.create_publisher(JointState, "/actuators", QOS)
        self.heard: list[str] = []
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda m: self.heard.append(m.status[0].message), 10
        )
        self.t_ns = START_NS
        self.frozen_ns = 0

    def send(self, mistake: str) -> None:
        """Publish one message of each."""
        self.t_ns += round(PERIOD * 1e9)
        rate = 0.2 * math.sin(self.t_ns * 1e-9)
        imu = Imu(angular_velocity=Vector3(x=rate, y=rate, z=rate))
        actuators = JointState(name=["e", "r", "a", "t"], position=[0.1, 0.0, 0.0, 0.5])
        for message in (imu, actuators):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.t_ns, 10**9)
        if mistake == "zero stamps":
            imu.header.stamp.sec = imu.header.stamp.nanosec = 0
        elif mistake == "frozen":
            self.frozen_ns = self.frozen_ns or self.t_ns
            imu.header.stamp.sec, imu.header.stamp.nanosec = divmod(self.frozen_ns, 10**9)
        elif mistake == "huge":
            imu.header.frame_id = "x" * 300_000
        elif mistake == "names":
            actuators.name = ["elevator", "rudder", "aileron", "throttle"]
        elif mistake == "clocks":
            actuators.header.stamp.sec += 100
        self.imu.publish(imu)
        self.actuators.publish(actuators)

    def until(self, words: str, mistake: str) -> bool:
        """Go on with a mistake until /diagnostics says the words."""

        def said() -> bool:
            self.send(mistake)
            self.executor.spin_once(timeout_sec=PERIOD)
            return any(words in line for line in self.heard)

        return wait_for(said, timeout=30.0)

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def source() -> Iterator[Source]:
    made = Source()
    yield made
    made.close()


MISTAKES = [
    ("zero stamps", "every message on '/imu/data' is dropped: their stamp is zero"),
    ("huge", "every message on '/imu/data' is dropped: it takes 3003"),
    ("frozen", "the stamps on '/imu/data' stand still at 17"),
    ("names", "every message on '/actuators' is dropped: "),
    ("clocks", "they run on different clocks"),
]


def test_mistakes_in_the_messages_are_named_one_after_the_other(
    source: Source, start_node: StartNode
) -> None:
    """With one node: what is wrong may also begin in flight, and end again."""
    names = "['e', 'r', 'a', 't']"
    node = start_node(
        parameters={
            "actuators.type": "sensor_msgs/msg/JointState",
            "actuators.channels": names,
            "state_file": "none",
        }
    )
    for mistake, words in MISTAKES:
        source.heard.clear()
        assert source.until(words, mistake), (mistake, source.heard[-3:], node.log)
        assert wait_for(lambda words=words: words in node.log), node.log
        source.heard.clear()
        assert source.until("learning", "") or source.heard[-1].startswith("paused"), mistake


def test_a_second_publisher_is_named(source: Source, start_node: StartNode) -> None:
    source.node.create_publisher(Imu, "/imu/data", QOS)
    node = start_node(parameters={"state_file": "none"})
    words = "'/imu/data' has 2 publishers, whose messages mix: /source, /source"
    assert wait_for(lambda: words in node.log, timeout=30.0), node.log
