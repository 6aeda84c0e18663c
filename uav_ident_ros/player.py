# SPDX-License-Identifier: Apache-2.0
"""Play recorded messages to a running node over DDS, and collect what it publishes.

`ros2 bag play` does the same for a pilot; this one is for the demonstration and the tests. It
can hold the recording back until the node has answered, so that nothing is ever lost and the
speed is whatever the machine gives.
"""

import math
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
from uav_ident_ros.guest import CLOCK_AHEAD_NS, LOOK_EVERY, Guest, StepClock
from uav_ident_ros.messages.types import NS_PER_S, header_ns
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.ros import latched

CLOCK_PERIOD_NS = 10_000_000
"""Interval of /clock, ns: 100 Hz, so that stamps on arrival are good to 10 ms."""

ANSWER_WITHIN_NS = 200_000_000
"""In step with the node: after t is played, the output of t less this is waited for, ns."""

CALL_AGAIN_AFTER = 1.0
"""Seconds without an answer after which a service call is repeated."""

PATIENCE = 60.0
"""Seconds after which an answer is missed; a busy machine may need them."""

SETTLE = 0.3
"""Seconds for what takes no longer on any machine, and cannot be asked for."""

START_UP_NS = 500_000_000
"""Recording time in which the node's first outputs are not waited for yet, ns."""

DEPTH = 1000
"""Depth of every queue of the player: more than it ever sends ahead."""


class PlayerError(Exception):
    """The node did not appear, or did not answer; the message says what was waited for."""


@dataclass
class Outputs:
    """What a node published, in the order of arrival."""

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
        """Forget everything."""
        for received in vars(self).values():
            received.clear()


class Player(Guest):
    """Publishes recorded messages and /clock, and listens to the node."""

    def __init__(
        self,
        topics: dict[str, type],  # Topics to publish and their message classes
        node_name: str = "/identifier",  # Full name of the node that listens
        clock: bool = True,  # Whether to publish /clock
        ending: Ending | None = None,  # As in `Guest`
    ) -> None:
        super().__init__("player", ending)
        self.outputs = Outputs()
        self._node_name = node_name
        self._publishers = {
            topic: self.node.create_publisher(kind, topic, DEPTH) for topic, kind in topics.items()
        }
        self._clock = StepClock(self.node, self._executor, CLOCK_PERIOD_NS, clock)
        out, name, last = self.outputs, self._node_name, latched(DEPTH)
        subscribe = self.node.create_subscription
        subscribe(JointState, f"{name}/coefficients_named", out.named.append, last)
        subscribe(Float64MultiArray, f"{name}/coefficients", out.coefficients.append, last)
        subscribe(Vector3Stamped, f"{name}/predicted_rates", out.predicted_rates.append, DEPTH)
        subscribe(Vector3Stamped, f"{name}/prediction_error", out.prediction_error.append, DEPTH)
        subscribe(DiagnosticArray, "/diagnostics", self._keep_status, DEPTH)

    def _keep_status(self, message: DiagnosticArray) -> None:
        self.outputs.status += [s for s in message.status if s.name == self._node_name]

    def wait_until(
        self, condition: Callable[[], bool], what: str, timeout: float = PATIENCE
    ) -> None:
        """Listen until `condition` holds; a PlayerError says `what` was waited for in vain."""
        if not self.spin_for(timeout, condition):
            raise PlayerError(f"waited {timeout:g} s in vain for {what}")

    def node_is_there(self) -> bool:
        """Whether the node listens to everything and offers its outputs."""
        publishers = [*self._publishers.values()]
        if self._clock.publisher is not None:
            publishers.append(self._clock.publisher)
        output = f"{self._node_name}/coefficients_named"
        return self.node.count_publishers(output) > 0 and all(
            publisher.get_subscription_count() > 0 for publisher in publishers
        )

    def wait_for_node(self) -> None:
        """Listen until the node hears this player and this player hears the node."""
        self.wait_until(
            self.node_is_there,
            f"node '{self._node_name}' to subscribe to {', '.join(self._publishers)}"
            + (" and /clock" if self._clock.publisher else ""),
        )
        self._wait_for_answer_to_a_call()
        self.spin_for(SETTLE)

    def _wait_for_answer_to_a_call(self) -> None:
        """Listen until the node answers a service.

        That the player knows the node does not mean that the node knows the player yet, and
        until then it hears nothing.
        """
        client = self.node.create_client(ListParameters, f"{self._node_name}/list_parameters")
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self.wait_until(client.service_is_ready, f"node '{self._node_name}'")
            answer = client.call_async(ListParameters.Request())
            if self.spin_for(CALL_AGAIN_AFTER, answer.done):
                self.node.destroy_client(client)
                return
            client.remove_pending_request(answer)
        raise PlayerError(f"waited {PATIENCE:g} s in vain for node '{self._node_name}' to answer")

    def send(self, topic: str, data: Any) -> None:
        """Publish one message, or its CDR bytes."""
        self._publishers[topic].publish(data)

    def send_clock(self, t_ns: int) -> bool:
        """Publish a time on /clock, even one before the last; return whether it is."""
        return self._clock.send(t_ns)

    def play(
        self,
        messages: Sequence[Message],  # In log-time order
        *,
        speed: float = 1.0,  # Times real time; inf for as fast as the node answers
        # Called with the log time (ns) about every 10 ms of it
        on_time: Callable[[int], None] = lambda t_ns: None,
        # Whether to wait for the node where it does not keep up, so that a busy machine plays
        # slower and loses nothing
        in_step: bool = False,
        start_up_ns: int = START_UP_NS,  # Of it, in which no output is waited for
    ) -> float:
        """Play in log-time order; between messages /clock goes on in its own steps.

        Returns how late /clock was, rms, s: what a busy machine adds to the stamps on arrival.
        """
        start_ns, start = messages[0].log_ns, time.monotonic()
        late: list[float] = []
        clock_ns, awaited_ns = start_ns, start_ns + start_up_ns
        if self.send_clock(clock_ns):  # which must arrive before the messages
            self.spin_for(SETTLE)
        for message in messages:
            while clock_ns + CLOCK_PERIOD_NS <= message.log_ns:
                clock_ns += CLOCK_PERIOD_NS
                due = start + (clock_ns - start_ns) / NS_PER_S / speed
                self.spin_for(due - time.monotonic())
                if in_step:
                    self._keep_in_step(clock_ns, start_ns, awaited_ns)
                late.append(time.monotonic() - due)
                on_time(clock_ns)
                self._clock.advance(clock_ns)
            self._publishers[message.topic].publish(message.data)
        self._flush()
        return math.sqrt(sum(x * x for x in late) / max(len(late), 1))

    def play_in_step(self, messages: Sequence[Message]) -> None:
        """Play as fast as the node answers, so that no message can be lost; forget what it said.

        What goes on where the node's last output was is in step from the start: a run of excitation
        would be aborted where /clock gets half a second ahead of the messages.
        """
        goes_on = 0 <= messages[0].log_ns - self.outputs.newest_ns < START_UP_NS
        self.outputs.clear()
        start_up_ns = 0 if goes_on else START_UP_NS
        self.play(messages, speed=math.inf, in_step=True, start_up_ns=start_up_ns)

    def _keep_in_step(self, t_ns: int, start_ns: int, awaited_ns: int) -> None:
        """Listen, and before `t_ns` is played wait for the output of a moment ago."""
        self._executor.spin_once(timeout_sec=0.0)
        wanted_ns = t_ns - ANSWER_WITHIN_NS
        if wanted_ns >= awaited_ns and not self._clock.wait(
            lambda: self.called_off() or self.outputs.newest_ns >= wanted_ns, t_ns, PATIENCE
        ):
            raise PlayerError(
                f"waited {PATIENCE:g} s in vain for the output of "
                f"{(wanted_ns - start_ns) / NS_PER_S:.2f} s into the recording"
            )

    def _flush(self) -> None:
        """Let the node's timer fire once more, and its last outputs arrive."""
        for _ in range(CLOCK_AHEAD_NS // CLOCK_PERIOD_NS):
            self._clock.advance()
            self.spin_for(LOOK_EVERY)
        self.spin_for(SETTLE)
        # A busy node may have seen all of these steps before the last messages.
        newest_ns = None
        while newest_ns != self.outputs.newest_ns:
            newest_ns = self.outputs.newest_ns
            self._clock.advance()
            self.spin_for(SETTLE)
