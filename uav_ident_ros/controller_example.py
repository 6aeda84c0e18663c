# SPDX-License-Identifier: Apache-2.0
"""The node `controller_example`: a rate controller on the identified model, to copy.

Rates and their references in, surfaces out, one command for each Imu message. The law is in
`uav_ident_ros.control`: incremental inversion (INDI) on measured angular acceleration, or inversion
of the identified model with a disturbance observer (``law: inversion``). Each axis uses identified,
last good or nominal control derivatives. With the parameter ``mode: fixed`` the law always uses the
nominal coefficients.
"""

import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3Stamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Header

from uav_ident_ros.client import (
    Coefficients,
    CoefficientSource,
    Excitation,
    Fallback,
    History,
    Refusal,
    subscribe,
    subscribe_excitation,
)
from uav_ident_ros.control import LAWS, Effect, Gains, RateController
from uav_ident_ros.files.meanings import AXIS_WORDS
from uav_ident_ros.identification.settings import Setting, SettingsError
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import FLU_TO_FRD, NS_PER_S, header_ns, stamp_ns, xyz
from uav_ident_ros.node.notices import without_numbers
from uav_ident_ros.node.program import read_parameters, run, spin

REPORT_PERIOD = 1.0
"""Period of reports on /diagnostics, s; changes are reported immediately."""

LONGEST_DISCOVERY, CHECK_PERIOD = 30.0, 0.05
"""In lock-step with a simulation: longest wait for the discovery of identifier and reference, and
period of the check, s of wall clock."""

PARAMETERS = (
    Setting("law", "str", "incremental", "", "Control law.", choices=tuple(LAWS)),
    Setting("mode", "str", "adaptive", "",
        "Coefficients in use: identified, or fixed to the nominal ones.",
        choices=("adaptive", "fixed")),
    Setting("nominal_file", "str", "", "",
        "Nominal coefficients.yaml, as of `replay`; none: the first usable set."),
    Setting("use_verdict", "bool", True, "", "Whether verdict/usable must be 1."),
    Setting("rate_gain", "float[]", (5.0, 4.0, 2.0), "1/s",
        "Acceleration per rate error of roll, pitch, yaw.", 0.0),
    Setting("bandwidth", "float", 0.0, "rad/s",
        "Bandwidth of the law's filter (INDI) or observer (inversion); 0: 20 or 8.", 0.0),
    Setting("trim", "float[]", (0.0, 0.0, 0.0, 0.0), "", "Trim; rad, throttle 0..1."),
    Setting("least", "float[]", (-0.4, -0.25, -0.25, 0.0), "", "Lower limit of each."),
    Setting("largest", "float[]", (0.4, 0.25, 0.25, 1.0), "", "Upper limit of each."),
    Setting("excitation_limit", "float[]", (0.0, 0.0, 0.0, 0.0), "",
        "Largest excitation of de dr da dth.", 0.0),
    Setting("delay", "float", 0.02, "s",
        "From a sample to the surface; in mode adaptive a measured delay replaces it.", 0.0),
    Setting("coefficients_delay", "float", 0.0, "s",
        "Least age of the coefficients in use; above 0.2 in lock-step with a simulation.", 0.0),
    Setting("reference_delay", "float", 0.0, "s",
        "Least age of the reference in use; two samples in lock-step with a simulation.", 0.0),
)  # fmt: skip


class ControllerExample(Node):
    """Rates and references in, commands out; one command for each Imu message."""

    def __init__(self) -> None:
        super().__init__("controller")
        value = read_parameters(self, PARAMETERS)
        self._value = value
        self._law = LAWS[value["law"]]
        self._adaptive = value["mode"] != "fixed"
        self._trim = np.array(value["trim"])
        nominal = Coefficients.from_file(value["nominal_file"]) if value["nominal_file"] else None
        if nominal is None and not self._adaptive:
            raise SettingsError("'mode' is 'fixed': 'nominal_file' must name the coefficients")
        self._source = CoefficientSource(
            Fallback.LAST_GOOD if self._adaptive else Fallback.NOMINAL,
            nominal,
            use_verdict=value["use_verdict"],
            delay=value["coefficients_delay"],
        )
        self._controller = None if nominal is None else self._make(nominal)
        coefficients = subscribe(self, self._source) if self._adaptive else None
        self._excitation = Excitation(value["excitation_limit"])
        subscribe_excitation(self, self._excitation)
        self._references: History[FloatArray] = History()
        self._reference_delay_ns = round(value["reference_delay"] * NS_PER_S)
        self._reported = (0, "")
        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._commands: Publisher | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        reference = self.create_subscription(
            Vector3Stamped, "rate_reference", self._on_reference, 50
        )
        self.create_subscription(Imu, "imu/data", self._on_imu, best_effort)
        delayed = (coefficients, "coefficients_delay"), (reference, "reference_delay")
        self._advertise_once_discovered([topic for topic, name in delayed if topic and value[name]])

    def _advertise_once_discovered(self, subscriptions: Sequence[Any]) -> None:
        """Advertise the commands once each has a publisher: the simulation then starts."""
        end = time.monotonic() + LONGEST_DISCOVERY

        def check() -> None:
            missing = any(not topic.get_publisher_count() for topic in subscriptions)
            if not missing or time.monotonic() > end:
                self.destroy_timer(timer)
                self._commands = self.create_publisher(JointState, "command", 50)

        # a steady clock, because the node's may be the simulation's, which does not run yet
        timer = self.create_timer(
            CHECK_PERIOD, check, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        check()

    def _make(self, nominal: Coefficients) -> RateController:
        value = self._value
        p, q, r = value["rate_gain"]
        gains = Gains((p, q, r), value["bandwidth"] or self._law.gains.bandwidth)
        return RateController(
            self._source,
            nominal,
            np.array([value["least"], value["largest"]]) - self._trim,
            value["delay"],
            self._law,
            self._adaptive,
            gains,
        )

    def _on_reference(self, message: Vector3Stamped) -> None:
        self._references.add(header_ns(message), np.array(xyz(message.vector)))

    def _on_imu(self, message: Imu) -> None:
        if self._commands is None:
            return
        t_ns = header_ns(message)
        x = np.array(xyz(message.angular_velocity)) * FLU_TO_FRD
        reference = self._references.at(t_ns - self._reference_delay_ns)
        if not np.isfinite(x if reference is None else x - reference).all():
            problem = "a rate or its reference is not finite: the surfaces stay where they are"
            self.get_logger().warning(problem, throttle_duration_sec=5.0)
        try:
            controller = self._ready(t_ns)
            u = controller.update(t_ns, x, np.zeros(3) if reference is None else reference)
            u = controller.inject(t_ns, u, self._excitation.at(t_ns))
            self._report(message.header, *effect_summary(controller.effect), controller)
        except Refusal as refusal:
            u = np.zeros(4)  # no coefficients: trim
            self._report(message.header, "flying on trim", str(refusal))
        raw = self._trim + u  # plain channels; others: raw = trim + pinv(mixing) u / scale
        self._commands.publish(
            JointState(
                header=message.header,
                name=["elevator", "rudder", "aileron"],
                position=raw[:3].tolist(),
            )
        )

    def _ready(self, t_ns: int) -> RateController:
        """Return the controller; the first usable set replaces a missing nominal one."""
        if self._controller is None:
            newest, why = self._source.newest(t_ns), self._source.refusal(t_ns)
            if newest is None or why:
                raise Refusal(why)
            self._controller = self._make(newest)
        return self._controller

    def _report(
        self, header: Header, line: str, why: str, controller: RateController | None = None
    ) -> None:
        """Report the coefficients in use: changes in the log, and all on /diagnostics."""
        line += f": {why}" if why else ""
        t_ns = stamp_ns(header.stamp)
        report = without_numbers(line)
        last_ns, logged = self._reported
        changed = report != logged
        if not changed and 0 <= t_ns - last_ns < REPORT_PERIOD * NS_PER_S:
            return
        if changed and why:
            self.get_logger().warning(line)
        elif changed:
            self.get_logger().info(line)
        self._reported = (t_ns, report)
        values = [] if controller is None else measured(controller)
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if why else DiagnosticStatus.OK,
            name=self.get_fully_qualified_name(),
            message=line,
            values=values,
        )
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))


def effect_summary(effect: Effect) -> tuple[str, str]:
    """Return the source of the coefficients in use, and why axes do not use identified ones."""
    groups: dict[str, list[str]] = {}
    reasons: dict[str, list[str]] = {}
    for axis, source, reason in zip(
        AXIS_WORDS.values(), effect.sources, effect.reasons, strict=True
    ):
        groups.setdefault(source, []).append(axis)
        if reason:
            reasons.setdefault(reason, []).append(axis)
    named = [f"{source} coefficients" + _of(axes) for source, axes in groups.items()]
    why = [reason + _of(axes) for reason, axes in reasons.items()]
    return "flying on " + " and ".join(named), "; ".join(why)


def _of(axes: list[str]) -> str:
    return "" if len(axes) == len(AXIS_WORDS) else f" ({', '.join(axes)})"


def measured(controller: RateController) -> list[KeyValue]:
    """Return the measured effect and delay of the inputs, for /diagnostics."""
    found = controller.effectiveness
    values = {"delay flown on": f"{1e3 * controller.delay.delay:.0f} ms"}
    for axis, factor, sigma in zip(AXIS_WORDS.values(), found.factor, found.sigma, strict=True):
        values[f"measured effect of {axis}"] = f"{factor:.2f} +- {sigma:.2f} of nominal"
    return [KeyValue(key=key, value=value) for key, value in values.items()]


def main(args: list[str] | None = None) -> int:
    """Run the node; the return value is the exit status."""
    return run("controller_example", ControllerExample, spin, args, __doc__, PARAMETERS)


if __name__ == "__main__":
    sys.exit(main())
