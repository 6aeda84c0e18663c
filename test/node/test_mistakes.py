# SPDX-License-Identifier: Apache-2.0
"""Mistakes at the start: the log and /diagnostics name each, with its cure, within 3 s."""

import math
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped, Vector3
from programs import wait_for
from rclpy.qos import QoSProfile, ReliabilityPolicy
from recordings import Spoil, put
from sensor_msgs.msg import Imu, JointState, MagneticField
from std_msgs.msg import Bool, Float64, Float64MultiArray

from uav_ident_ros.guest import Guest
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.node.waiting import silence_reason
from uav_ident_ros.process import NodeProcess
from uav_ident_ros.ros import to_stamp

PERIOD = 0.01
START_NS = 1_700_000_000_000_000_000

STATUSES = 3
"""Messages on /diagnostics, one a second; the last must name a mistake."""

DISCOVERY = 2
"""Additional messages for the discovery or loss of an endpoint on a busy machine."""

SENT = 30
"""Messages on each topic between two counted statuses: a busy machine may delay the source, not
the node."""

PARAMETERS = {
    "actuators.type": "sensor_msgs/msg/JointState",
    "actuators.channels": "['e', 'r', 'a', 't']",
    "airspeed.type": "std_msgs/msg/Float64",
    "armed.type": "std_msgs/msg/Bool",
    "qos_overrides./actuators.subscription.reliability": "reliable",
    "state_file": "none",
}

Topic = tuple[str, type, bool]
"""Name, message type, and whether it is reliable."""

RIGHT: dict[str, Topic] = {
    "imu": ("/imu/data", Imu, False),
    "actuators": ("/actuators", JointState, True),
    "airspeed": ("/airspeed", Float64, False),
    "armed": ("/armed", Bool, True),
    "excitation": ("/excitation", JointState, True),
}

Change = Topic | str | Callable[[Any], object] | None
"""Another topic, `SILENT` or `TWICE`, or a function of each message; None: no publisher."""

SILENT, TWICE = "silent", "twice"


def stamped(t_ns: int) -> Spoil:
    return put("header.stamp", to_stamp(t_ns))


def frozen() -> Spoil:
    """Return a function that gives every message the stamp of the first."""
    first: list[Any] = []

    def change(message: Any) -> None:
        first.append(message.header.stamp)
        message.header.stamp = first[0]

    return change


IMU = "sensor_msgs/msg/Imu"
DROPPED = "every message on '{}' is dropped: {}"
MISTAKES: dict[str, tuple[str, dict[str, Change]]] = {
    # mistake: required text, and the changes that cause it
    "armed is set, nobody publishes it": ("no message on '/armed' yet: nobody", {"armed": None}),
    "no driver": (
        "nobody publishes '/imu/data': no other topic fits; does its source run, with ROS_DOMAIN",
        {"imu": None}),
    "another name": (
        "'/imu/data_raw' carries sensor_msgs/msg/Imu: start with -r imu/data:=/imu/data_raw",
        {"imu": ("/imu/data_raw", Imu, False), "armed": ("/gimbal/orientation", Imu, False)}),
    "another sensor on the topic": (
        "'/imu/data' of /source carries sensor_msgs/msg/MagneticField, but",
        {"imu": ("/imu/data", MagneticField, False)}),
    "a driver that sends nothing": ("'/imu/data' has a publisher, /source, which sends nothing",
        {"imu": SILENT}),
    "another type elsewhere": (
        "-r actuators:=/servos -p actuators.type:=std_msgs/msg/Float64MultiArray",
        {"actuators": ("/servos", Float64MultiArray, True)}),
    "another type on the topic": ("set 'actuators.type' to std_msgs/msg/Float64MultiArray",
        {"actuators": ("/actuators", Float64MultiArray, True)}),
    "QoS that does not fit": (
        "'qos_overrides./actuators.subscription.reliability' asks for reliable: set it to best_",
        {"actuators": ("/actuators", JointState, False)}),
    # the node's coefficients have the type of an input, but are none
    "actuators end": (
        "on '/actuators' for more than 2 s: nobody publishes '/actuators': no other topic fits",
        {"actuators": None}),
    "airspeed is set, nobody measures it": (
        "no message on '/airspeed' for more than 2 s: nobody publishes", {"airspeed": None}),
    "airspeed of another type": ("set 'airspeed.type' to geometry_msgs/msg/TwistStamped",
        {"airspeed": ("/airspeed", TwistStamped, False)}),
    "two drivers": ("'/imu/data' has 2 publishers, whose messages mix: /source, /source; end one",
        {"imu": TWICE}),
    "two sources of excitation": ("'/excitation' has 2 publishers, whose messages mix: /source,",
        {"excitation": TWICE}),
    "two nodes of one name": ("2 nodes are called '/identifier': their outputs mix",
        {"node": TWICE}),
    "other names": (DROPPED.format("/actuators", "there is no channel 'e' among elevator, rudder"),
        {"actuators": put("name", ["elevator", "rudder", "aileron", "throttle"])}),
    "channels of another kind": (
        DROPPED.format("/actuators", "their values are larger than any aircraft has"),
        {"actuators": put("position", [2e6] * 4)}),
    "two clocks": ("different clocks. Play a bag with --clock and set use_sim_time, or synchron",
        {"actuators": stamped(START_NS + 999 * 10**9)}),
    "airspeed of another unit": (
        DROPPED.format("/airspeed", "their values are larger than any aircraft has: look at un"),
        {"airspeed": put("data", 20_000.0)}),
    "no stamps": (DROPPED.format("/imu/data", "their stamp is zero or negative: let"),
        {"imu": stamped(0)}),
    "stamps stand still": (DROPPED.format("/imu/data", "their stamps repeat"), {"imu": frozen()}),
    "stamps of another century": (
        DROPPED.format("/imu/data", "their stamp is beyond 2038: look at the clock"),
        {"imu": stamped(2**31 * 10**9 - 1)}),
    "rates that are no numbers": (
        DROPPED.format("/imu/data", "their values are not finite numbers: look at the source"),
        {"imu": put("angular_velocity.x", math.nan)}),
    "rates in another unit": (
        DROPPED.format("/imu/data", "their values are larger than any aircraft has: look at un"),
        {"imu": put("angular_velocity.x", 4000.0)}),
    "no Imu at all": (DROPPED.format("/imu/data", "it takes 3003"),
        {"imu": put("header.frame_id", "x" * 300_000)}),
    "axes against the convention": (
        "'imu_frd' contradicts imu.convention 'flu': set it to 'frd', or correct",
        {"imu": put("header.frame_id", "imu_frd")}),
}  # fmt: skip


class Source(Guest):
    """Publisher of the node's inputs, correct or with a mistake; receives /diagnostics."""

    def __init__(self) -> None:
        super().__init__("source")
        self.received: list[str] = []
        self._sent = self._statuses = 0
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive, 10)
        self.changes: dict[str, Change] = {}
        self._publishers: dict[tuple[str, Topic, int], Any] = {}
        self._twin: Any = None
        self._t_ns = START_NS

    def _receive(self, message: DiagnosticArray) -> None:
        if self._sent >= SENT:
            self._sent, self._statuses = 0, self._statuses + 1
        (status,) = message.status
        values = {entry.key: entry.value for entry in status.values}
        self.received.append(f"{status.message}; {values['warnings']}")
        assert (status.level == DiagnosticStatus.ERROR) == status.message.startswith("fault: ")

    def make(self, changes: dict[str, Change]) -> None:
        """Apply these changes to all later messages."""
        self.changes = changes
        wanted = set()
        for stream, right in RIGHT.items():
            change = changes.get(stream, right)
            if change is not None:
                topic = change if isinstance(change, tuple) else right
                wanted |= {(stream, topic, k) for k in range(2 if change == TWICE else 1)}
        for gone in self._publishers.keys() - wanted:
            self.node.destroy_publisher(self._publishers.pop(gone))
        for key in wanted - self._publishers.keys():
            name, kind, reliable = key[1]
            policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
            self._publishers[key] = self.node.create_publisher(
                kind, name, QoSProfile(depth=10, reliability=policy)
            )
        if self._twin is not None:
            self._twin.destroy_node()
        twice = changes.get("node") == TWICE
        self._twin = rclpy.create_node("identifier", context=self.node.context) if twice else None
        self.received.clear()
        self._sent = self._statuses = 0

    def send(self) -> None:
        """Publish one message of each stream."""
        self._t_ns += round(PERIOD * 1e9)
        self._sent += 1
        rate = 0.2 * math.sin(self._t_ns * 1e-9)
        for (stream, (_, kind, _), _), publisher in self._publishers.items():
            change, message = self.changes.get(stream), kind()
            if change == SILENT:
                continue
            if kind is Imu:
                message.angular_velocity = Vector3(x=rate, y=rate, z=rate)
            elif kind is JointState:
                excites = stream == "excitation"
                message.name = [*INPUTS] if excites else ["e", "r", "a", "t"]
                message.position = [0.0] * 4 if excites else [0.1, 0.0, 0.0, 0.5]
            elif kind in (Float64, Bool):
                message.data = kind is Bool or 20.0
            if hasattr(message, "header"):
                message.header.stamp = to_stamp(self._t_ns)
            if callable(change):
                change(message)
            publisher.publish(message)
        self._executor.spin_once(timeout_sec=PERIOD)

    def reports(self, words: str) -> bool:
        """Publish until /diagnostics contains a text or the time is over; return success."""

        def ended() -> bool:
            self.send()
            return self._statuses >= STATUSES + DISCOVERY or any(words in h for h in self.received)

        return wait_for(ended) and any(words in h for h in self.received)

    def close(self) -> None:
        self.make({})  # no second node of that name
        super().close()


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    log = tmp_path_factory.mktemp("node") / "node.log"
    with NodeProcess("uav_ident_ros.node", log, PARAMETERS) as started:
        yield started


@pytest.fixture(scope="module")
def source() -> Iterator[Source]:
    made = Source()
    yield made
    made.close()


def until_no_problem(source: Source) -> None:
    """Publish without a mistake until the node receives every stream."""
    source.make({})

    def well() -> bool:
        source.send()
        return any(line.startswith(("paused", "learning")) for line in source.received[-1:])

    assert wait_for(well), source.received


@pytest.mark.parametrize("mistake", MISTAKES)
def test_every_mistake_is_named_with_its_cure(
    mistake: str, source: Source, node: NodeProcess
) -> None:
    """One node serves all cases: a mistake may also begin and end in flight."""
    words, changes = MISTAKES[mistake]
    if "for more than" in words:  # a stream must exist before it stops
        until_no_problem(source)
    logged = len(node.log)
    source.make(changes)
    assert source.reports(words), (source.received, node.log[logged:])
    assert wait_for(lambda: words in node.log[logged:]), node.log[logged:]


def test_the_node_recovers_after_the_mistakes(source: Source, node: NodeProcess) -> None:
    until_no_problem(source)
    assert node.poll() is None


@pytest.mark.parametrize(
    ("topics", "best"),
    [
        (["/drone1/imu/data", "/drone2/gyro/raw"], "/drone2/gyro/raw"),
        (["/drone1/imu/data"], "/drone1/imu/data"),
    ],
)
def test_a_topic_of_the_own_vehicle_is_advised_first(topics: list[str], best: str) -> None:
    class Graph:
        """Stand-in for a node of the second vehicle."""

        get_namespace = staticmethod(lambda: "/drone2")
        get_topic_names_and_types = staticmethod(lambda: [(name, [IMU]) for name in topics])
        get_publishers_info_by_topic = staticmethod(lambda _: [])
        count_publishers = staticmethod(topics.count)

    wanted = SimpleNamespace(
        topic="/drone2/imu/data", stream=STREAMS[0], feed=SimpleNamespace(type_name=IMU)
    )
    assert f": '{best}' carries {IMU}" in silence_reason(Graph, wanted)  # type: ignore[arg-type]
