# SPDX-License-Identifier: Apache-2.0
"""What the graph says about an input that is silent, and what to do."""

import time
from collections.abc import Iterator

import pytest
import rclpy
from node_process import wait_for
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages.feed import Feed
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.node.diagnostics import TickMeter
from uav_ident_ros.node.graph import why_silent
from uav_ident_ros.node.inputs import InputMonitor

IMU = "sensor_msgs/msg/Imu"
ARRAY = "std_msgs/msg/Float64MultiArray"
QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


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


def wanted(name: str = "imu/data", type_name: str = IMU) -> InputMonitor:
    (stream,) = [stream for stream in STREAMS if stream.topic == name]
    settings = Settings.from_values({stream.setting: type_name})
    return InputMonitor(Feed(stream, OnlineIdentifier(settings), bytes), f"/{name}")


def reports(node: Node, input_: InputMonitor, words: str) -> bool:
    return wait_for(lambda: words in why_silent(node, input_))


def test_the_nearest_topic_of_the_type_is_named(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    for topic in ("/imu/data_raw", "/gimbal/orientation"):
        driver.create_publisher(Imu, topic, QOS)
    assert reports(
        listener, wanted(), f"'/imu/data_raw' carries {IMU}: start with -r imu/data:=/imu"
    )


def test_outputs_of_an_identifier_are_no_inputs(graph: tuple[Node, Node]) -> None:
    listener, driver = graph
    driver.create_publisher(JointState, "/other/identifier/coefficients_named", QOS)
    driver.create_publisher(Float64MultiArray, "/other/identifier/coefficients", QOS)
    assert wait_for(lambda: listener.count_publishers("/other/identifier/coefficients") > 0)
    assert "no other topic fits" in why_silent(listener, wanted("actuators", ARRAY))


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
