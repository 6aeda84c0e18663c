# SPDX-License-Identifier: Apache-2.0
"""The node `identifier`: the identification pipeline behind ROS topics and services.

The node has no estimation logic: it passes messages in, requests due ticks and publishes estimates.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockChange, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from uav_ident_ros.files.coefficients_file import initial_coefficients
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import EXCITATION, NS
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.node import diagnostics
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.node.excite import Excite
from uav_ident_ros.node.inputs import Inputs
from uav_ident_ros.node.memory import Memory
from uav_ident_ros.node.notices import Guard, Throttle, without_numbers
from uav_ident_ros.node.outputs import Outputs
from uav_ident_ros.node.parameters import declare, follow_changes, settings_of
from uav_ident_ros.node.program import spin
from uav_ident_ros.node.waiting import Waiting
from uav_ident_ros.ros import RELIABLE

DIAGNOSTICS_PERIOD = 1.0
"""Interval of /diagnostics, s, on a steady clock."""

LOOKS_PER_TICK = 5
"""Requests for due ticks per tick period. With one, a tick would wait for up to a period, 25 ms in
the mean, and controllers with it."""

MOST_WAITING = 1000
"""Most waiting ticks and held messages, 5 s at the highest `update_rate`: then /clock stands still
while messages arrive, and they would pile up."""


class IdentifierNode(Node):
    """The node: inputs, ticks, outputs, services, diagnostics.

    Raises
    ------
    SettingsError, MessageTypeError, CoefficientsFileError
        If the parameters cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("identifier")
        settings = settings_of(self, [stream.topic for stream in STREAMS])
        self.identifier = OnlineIdentifier(settings, initial_coefficients(settings))
        declare(self, settings)
        self._guard = Guard(Throttle(partial(self._log, DiagnosticStatus.ERROR)))
        follow_changes(self, settings, self.identifier.reconfigure)
        warnings = Throttle(partial(self._log, DiagnosticStatus.WARN))
        self._inputs = Inputs(self, self.identifier, warnings, self._guard)
        self._waiting = Waiting(self, self.identifier, self._inputs.all.values())
        self._outputs = Outputs(self, self.identifier.structure)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._logged, self._warnings = "", list[str]()  # The last state and warnings
        injected = self._inputs.all[EXCITATION].subscription
        self._excite = Excite(self, self.identifier, injected)
        self._estimate: Estimate | None = None
        period = 1.0 / (LOOKS_PER_TICK * settings.update_rate)
        self._meter = diagnostics.TickMeter(period)
        self._memory = Memory(self.identifier, self.get_fully_qualified_name(), self.get_logger())
        self._memory.start()
        self._offer(Trigger, "reset", self._reset)
        self._offer(Trigger, "save", lambda _: self._memory.save(self._estimate))
        self._offer(SetBool, "adapt", self._adapt)
        self._offer(SetBool, "excite", lambda request: self._excite.request(request.data))
        self._watch_time(period, Duration(seconds=settings.time_jump))

    # -- wiring ----------------------------------------------------------------------------

    def _offer(self, kind: type, name: str, act: Callable[[Any], tuple[bool, str]]) -> None:
        """Offer a service whose response and log line report the success and the result."""

        def answer(request: Any, response: Any) -> Any:
            with self._guard(name):
                self._inputs.empty()
                response.success, response.message = act(request)
                level = DiagnosticStatus.OK if response.success else DiagnosticStatus.ERROR
                self._log(level, f"{name}: {response.message}")
            response.message = response.message or self._guard.problem
            return response

        self.create_service(kind, f"~/{name}", answer)

    def _watch_time(self, period: float, jump: Duration) -> None:
        """Create the timers of ticks and, on a steady clock, diagnostics; handle time jumps."""
        recover = partial(self._restart, "an internal error")
        self.create_timer(period, self._guard("on_timer", recover)(self._on_timer))
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        diagnose = self._guard("on_diagnostics")(self._on_diagnostics)
        self.create_timer(DIAGNOSTICS_PERIOD, diagnose, clock=self._steady)
        # The callback is removed with its handle.
        self._jump_handle = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=jump,
                min_backward=Duration(nanoseconds=-jump.nanoseconds),
                on_clock_change=True,
            ),
            post_callback=self._guard("on_jump")(self._on_jump),
        )

    # -- ticks -----------------------------------------------------------------------------

    def _on_timer(self) -> None:
        self._meter.called()
        self._inputs.empty()
        while (t_ns := self.identifier.intake.due) is not None:
            start = time.perf_counter()
            estimate = self.identifier.update(t_ns)
            self._meter.ticked(time.perf_counter() - start)
            if estimate is not None:
                self._estimate = estimate
                self._outputs.publish(estimate, self._inputs.rates.frame_id or "")
                self._excite.tick(estimate)
                self._meter.published((self.get_clock().now().nanoseconds - t_ns) * NS)
        self._excite.watch()

    def _restart(self, why: str, *, cold: bool = False) -> None:
        """Abort the excitation, and restart the filters, or start cold."""
        self._excite.abort(why)
        if cold:
            self.identifier.reset()
            self._estimate = None
        else:
            self.identifier.restart()

    def _on_jump(self, jump: TimeJump) -> None:
        """Restart after a jump of /clock; cold if it went back under use_sim_time."""
        self._inputs.empty()
        now_ns = self.get_clock().now().nanoseconds
        if jump.clock_change == ClockChange.ROS_TIME_NO_CHANGE:
            if now_ns == jump.delta.nanoseconds:
                return  # the first /clock is no jump
            cold = jump.delta.nanoseconds < 0
            what = f"/clock jumped by {jump.delta.nanoseconds * NS:+.3f} s"
        else:
            cold, what = False, "the node's clock changed"
        self._restart("the time jumped", cold=cold)
        kept = "starting cold" if cold else "filters restart, the coefficients stay"
        self.get_logger().warning(f"{what}: {kept}")

    # -- services --------------------------------------------------------------------------

    def _reset(self, _: Trigger.Request) -> tuple[bool, str]:
        self._restart("reset", cold=True)
        self._memory.forget()
        self._guard.problem = ""
        return True, "started cold"

    def _adapt(self, request: SetBool.Request) -> tuple[bool, str]:
        self.identifier.supervisor.adapt = bool(request.data)
        return True, "adaptation is switched " + ("on" if request.data else "off")

    # -- diagnostics -----------------------------------------------------------------------

    def _on_diagnostics(self) -> None:
        self._inputs.empty()
        if (waiting := self.identifier.intake.waiting) > MOST_WAITING:
            self._restart("no tick is computed")
            self.get_logger().warning(
                f"{waiting} ticks and messages dropped: the clock stands still"
            )
        self._memory.attend(self._estimate, time.monotonic())
        warnings = self._waiting.warnings()
        for line in warnings:
            if line not in self._warnings:
                self._log(DiagnosticStatus.WARN, line)
        self._warnings = warnings
        state, reason = self._state()
        line = f"{state}: {reason}" if reason else state
        before, self._logged = self._logged, without_numbers(line)
        if self._logged != before:
            self._log(diagnostics.LEVELS[state], line)
        status = DiagnosticStatus(
            level=diagnostics.LEVELS[state],
            name=self.get_fully_qualified_name(),
            message=line,
            values=[KeyValue(key=label, value=value) for label, value in self._values()],
        )
        header = Header(stamp=self.get_clock().now().to_msg())
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))

    def _log(self, level: bytes, line: str) -> None:
        log = self.get_logger()
        # rclpy allows one severity per line of source.
        if level == DiagnosticStatus.OK:
            log.info(line)
        elif level == DiagnosticStatus.WARN:
            log.warning(line)
        else:
            log.error(line)

    def _state(self) -> tuple[str, str]:
        """Return state and reason: those of faults first, then of inputs, then of the estimate."""
        missing = self._waiting.reason(self._meter.count)
        fault = (
            self._guard.problem
            or self._inputs.rates.fault
            or (self.identifier.intake.fault if self._waiting.imu_moves else "")
        )
        if fault:
            return "fault", fault
        if missing or self._estimate is None:
            return "waiting", missing or "the first tick is not due yet"
        return self._estimate.state, self._estimate.reason

    def _values(self) -> Iterator[tuple[str, str]]:
        """Yield the values of the status, each with its label."""
        yield "structure", self.identifier.settings.structure
        yield "estimator", self.identifier.settings.estimator
        yield "use_sim_time", str(self.get_clock().ros_time_is_active).lower()
        yield "internal errors", str(self._guard.count)
        yield "warnings", "; ".join(self._warnings) or "none"
        if self._estimate is not None:
            yield from diagnostics.estimate_values(self._estimate, self.identifier)
        yield from diagnostics.grouped("ticks", self._meter.values())
        for name, own in self._inputs.all.items():
            if name != EXCITATION or own.feed.received:
                yield from diagnostics.grouped(name, own.values())
        yield from diagnostics.grouped("excite", self._excite.values())

    def finish(self) -> None:
        """Stop the excitation and save the coefficients at an orderly end of the program."""
        self._excite.abort("the program ends")
        self._memory.finish(self._estimate)


def work(node: IdentifierNode, ending: Ending) -> int:
    """Run `node` until a signal ends it, then save the coefficients."""
    status = spin(node, ending)
    node.finish()
    return status
