# SPDX-License-Identifier: Apache-2.0
"""Play recorded messages to a running node over DDS, and collect its outputs.

The demonstration and the tests use it in place of `ros2 bag play`. In step with the node, it waits
for the node's outputs: no message is lost, and the machine sets the speed.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.srv import ListParameters
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from uav_ident_ros.bags.reading import Message
from uav_ident_ros.guest import CLOCK_AHEAD_NS, POLL_PERIOD, Guest, StepClock
from uav_ident_ros.messages.published import NAMED
from uav_ident_ros.messages.types import NS_PER_S, header_ns
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.offline import NODE_NAME
from uav_ident_ros.ros import latched

CLOCK_PERIOD_NS = 10_000_000
"""Period of /clock, ns: at 100 Hz stamps on arrival are within 10 ms."""

ANSWER_WITHIN_NS = 200_000_000
"""In step with the node: largest lag of its outputs behind the played messages, ns."""

CALL_AGAIN_AFTER = 1.0
"""Time without an answer after which a service call is repeated, s."""

ANSWER_PATIENCE = 60.0
"""Longest wait for an answer, s, sufficient on a busy machine."""

SETTLE = 0.3
"""Time for deliveries that cannot be observed, s, sufficient on any machine."""

START_UP_NS = 500_000_000
"""Initial recording time without waiting for outputs, ns."""

DEPTH = 1000
"""Depth of every queue of the player, larger than the number of unanswered messages."""


class PlayerError(Exception):
    """The node did not appear or answer in time; the message names the missing answer."""


@dataclass
class NodeOutputs:
    """Outputs of a node, in the order of arrival."""

    named: list[JointState] = field(default_factory=list)
    coefficients: list[Float64MultiArray] = field(default_factory=list)
    predicted_rates: list[Vector3Stamped] = field(default_factory=list)
    prediction_error: list[Vector3Stamped] = field(default_factory=list)
    status: list[DiagnosticStatus] = field(default_factory=list)

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest tick, ns; 0 before the first."""
        return header_ns(self.named[-1]) if self.named else 0

    def clear(self) -> None:
        """Discard all outputs."""
        for received in vars(self).values():
            received.clear()


class Player(Guest):
    """Publisher of recorded messages and /clock, and subscriber of the node's outputs."""

    def __init__(
        self,
        topics: dict[str, type],  # Topics to publish and their message classes
        clock: bool = True,  # Whether to publish /clock
        ending: Ending | None = None,  # As in `Guest`
    ) -> None:
        super().__init__("player", ending)
        self.outputs = NodeOutputs()
        self._publishers = {
            topic: self.node.create_publisher(kind, topic, DEPTH) for topic, kind in topics.items()
        }
        self.clock = StepClock(self.node, self._executor, CLOCK_PERIOD_NS, clock)
        if self.clock.publisher is not None:
            self._publishers["/clock"] = self.clock.publisher
        out, name, last = self.outputs, NODE_NAME, latched(DEPTH)
        subscribe = self.node.create_subscription
        subscribe(JointState, f"{name}/{NAMED}", out.named.append, last)
        subscribe(Float64MultiArray, f"{name}/coefficients", out.coefficients.append, last)
        subscribe(Vector3Stamped, f"{name}/predicted_rates", out.predicted_rates.append, DEPTH)
        subscribe(Vector3Stamped, f"{name}/prediction_error", out.prediction_error.append, DEPTH)
        subscribe(DiagnosticArray, "/diagnostics", self._keep_status, DEPTH)

    def _keep_status(self, message: DiagnosticArray) -> None:
        self.outputs.status += [s for s in message.status if s.name == NODE_NAME]

    def wait_until(
        self, condition: Callable[[], bool], what: str, timeout: float = ANSWER_PATIENCE
    ) -> None:
        """Spin until `condition` holds; a PlayerError on a timeout names `what` is missing."""
        if not self.spin_for(timeout, condition):
            raise PlayerError(f"waited {timeout:g} s in vain for {what}")

    def node_is_there(self) -> bool:
        """Return whether the node subscribes to all topics and publishes its outputs."""
        return self.node.count_publishers(f"{NODE_NAME}/{NAMED}") > 0 and all(
            publisher.get_subscription_count() > 0 for publisher in self._publishers.values()
        )

    def wait_for_node(self) -> None:
        """Spin until the node and this player have discovered each other."""
        wanted = f"node '{NODE_NAME}' to subscribe to {', '.join(self._publishers)}"
        self.wait_until(self.node_is_there, wanted)
        self._wait_for_service()
        self.spin_for(SETTLE)

    def _wait_for_service(self) -> None:
        """Spin until the node answers a service.

        Discovery is one-sided at first: a node that the player has discovered may not receive its
        messages yet.
        """
        client = self.node.create_client(ListParameters, f"{NODE_NAME}/list_parameters")
        end = time.monotonic() + ANSWER_PATIENCE
        while time.monotonic() < end:
            self.wait_until(client.service_is_ready, f"node '{NODE_NAME}'")
            answer = client.call_async(ListParameters.Request())
            if self.spin_for(CALL_AGAIN_AFTER, answer.done):
                self.node.destroy_client(client)
                return
            client.remove_pending_request(answer)
        raise PlayerError(f"waited {ANSWER_PATIENCE:g} s in vain for node '{NODE_NAME}' to answer")

    def send(self, topic: str, data: Any) -> None:
        """Publish one message, or its CDR bytes."""
        self._publishers[topic].publish(data)

    def play(
        self,
        messages: Sequence[Message],  # In log-time order
        *,
        speed: float = 1.0,  # Times real time; inf for the node's speed
        # Called with the log time (ns), in steps of about 10 ms
        on_time: Callable[[int], None] = lambda t_ns: None,
        # Whether to wait for a node that lags: a busy machine then plays slower and loses no
        # message
        in_step: bool = False,
        start_up_ns: int = START_UP_NS,  # Initial log time without waiting for outputs
    ) -> None:
        """Play messages in log-time order, with the steps of /clock between them."""
        start_ns, start = messages[0].log_ns, time.monotonic()
        clock_ns, awaited_ns = start_ns, start_ns + start_up_ns
        if self.clock.send(clock_ns):  # a jump back must arrive before the messages
            self.spin_for(SETTLE)
        for message in messages:
            while clock_ns + CLOCK_PERIOD_NS <= message.log_ns:
                clock_ns += CLOCK_PERIOD_NS
                elapsed = (clock_ns - start_ns) / NS_PER_S / speed
                self.spin_for(start + elapsed - time.monotonic())
                if in_step:
                    self._keep_in_step(clock_ns, start_ns, awaited_ns)
                on_time(clock_ns)
                self.clock.advance(clock_ns)
            self._publishers[message.topic].publish(message.data)
        self._flush()

    def _keep_in_step(self, t_ns: int, start_ns: int, awaited_ns: int) -> None:
        """Spin, and wait for the output of `ANSWER_WITHIN_NS` before `t_ns`."""
        self._executor.spin_once(timeout_sec=0.0)
        wanted_ns = t_ns - ANSWER_WITHIN_NS
        if wanted_ns >= awaited_ns and not self.clock.wait(
            lambda: self.end_requested() or self.outputs.newest_ns >= wanted_ns,
            t_ns,
            ANSWER_PATIENCE,
        ):
            raise PlayerError(
                f"waited {ANSWER_PATIENCE:g} s in vain for the output of "
                f"{(wanted_ns - start_ns) / NS_PER_S:.2f} s into the recording"
            )

    def _flush(self) -> None:
        """Advance /clock until the node's last outputs have arrived."""
        for _ in range(CLOCK_AHEAD_NS // CLOCK_PERIOD_NS):
            self.clock.advance()
            self.spin_for(POLL_PERIOD)
        self.spin_for(SETTLE)
        # A busy node may have received all of these steps before the last messages.
        newest_ns = None
        while newest_ns != self.outputs.newest_ns:
            newest_ns = self.outputs.newest_ns
            self.clock.advance()
            self.spin_for(SETTLE)
