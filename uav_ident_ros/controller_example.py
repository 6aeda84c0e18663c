# SPDX-License-Identifier: Apache-2.0
"""The node `controller_example`: a rate controller on the identified model, to copy.

Model-based inversion with a disturbance observer. With the identified ``xdot = A f(x, u)``

    u = B^-1 (reference' + K (reference - x) - d - A f(x, 0))

where d is what the model does not explain: trim, gusts, the flow angles, an error of A or B. An
observer finds it from the rates and the commands that act by now, without differentiating::

    xhat' = A f(x, u) + d + 2 w (x - xhat)        d' = w^2 (x - xhat)

So the loop has integral action and is slow, not lost, while the model is wrong. With the
parameter ``mode: fixed`` the same law keeps to the nominal coefficients for ever.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3Stamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Header

from uav_ident_ros.client import (
    AttitudeModel,
    Coefficients,
    CoefficientSource,
    Excitation,
    Fallback,
    History,
    Refusal,
    subscribe,
    subscribe_excitation,
)
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.node.program import run, spin
from uav_ident_ros.node.usage import node_usage

FLU_TO_FRD = np.array([1.0, -1.0, -1.0])
RATE_GAIN = np.array([5.0, 4.0, 2.0])
"""K: acceleration per rate error of roll, pitch, yaw, 1/s."""

OBSERVER = np.array([8.0, 8.0, 4.0])
"""w: bandwidth of the disturbance observer, rad/s; what the delay allows, a third of it at most."""

REFERENCE_TIME = 0.1
"""Time constant of the reference's derivative, s."""

MAX_INTERVAL = 0.1
"""Interval of the Imu above which the loop starts afresh, s."""

REPORT_PERIOD = 1.0
"""Time between reports on /diagnostics, s; a change is reported at once."""

PARAMETERS: dict[str, Any] = {
    "mode": "adaptive",  # or fixed: the nominal coefficients for ever
    "nominal_file": "",  # coefficients.yaml of `replay`, the author's own
    "fallback": "last good",  # refuse, last good, nominal
    "heed_verdict": True,
    "trim": [0.0, 0.0, 0.0, 0.0],  # elevator, rudder, aileron, throttle
    "least": [-0.4, -0.25, -0.25, 0.0],
    "largest": [0.4, 0.25, 0.25, 1.0],
    "excitation_limit": [0.0, 0.0, 0.0, 0.0],  # largest that is ever added to de dr da dth
    "delay": 0.02,  # s
    "coefficients_delay": 0.0,  # s; above 0.2 in lock-step with a simulation
    "reference_delay": 0.0,  # s; two samples in lock-step with a simulation
}
"""Parameters and their defaults."""


class RateLaw:
    """The control law.

    Parameters
    ----------
    limits : (2, 4) array
        Least and largest de, dr, da, dth, deviations from trim.
    delay : float
        From a sample's stamp to the surface that its command moves, s.
    """

    def __init__(self, limits: FloatArray, delay: float) -> None:
        self._limits = limits
        self._delay_ns = round(delay * 1e9)
        self._last_ns = 0

    def restart(
        self, t_ns: int, model: AttitudeModel, x: FloatArray, reference: FloatArray
    ) -> None:
        """Forget the past: the first sample, or one after a gap."""
        self._last_ns, self._model = t_ns, model
        self._commands: History[FloatArray] = History()
        self._xhat, self._reference, self._disturbance = x, reference, np.zeros(3)

    def update(
        self, t_ns: int, model: AttitudeModel, x: FloatArray, reference: FloatArray
    ) -> FloatArray:
        """Return de, dr, da, dth for measured and wanted rates, (3,), rad/s, FRD.

        Raises
        ------
        Refusal
            If the model cannot be inverted.
        """
        dt = (t_ns - self._last_ns) * 1e-9
        if not 0.0 < dt < MAX_INTERVAL:
            self.restart(t_ns, model, x, reference)
            dt = 0.0
        self._last_ns = t_ns
        acting = self._commands.at(t_ns - self._delay_ns)
        acting = np.zeros(4) if acting is None else acting
        known = model.acceleration(x, acting)
        # a new model explains more or less of what goes on: no bump in the sum of both
        self._disturbance = self._disturbance + self._model.acceleration(x, acting) - known
        self._model = model
        error = x - self._xhat
        self._xhat = self._xhat + dt * (known + self._disturbance + 2.0 * OBSERVER * error)
        self._disturbance = self._disturbance + dt * OBSERVER**2 * error
        reference_rate = (reference - self._reference) / REFERENCE_TIME
        self._reference = self._reference + dt * reference_rate
        wanted = reference_rate + RATE_GAIN * (reference - x) - self._disturbance
        u = model.invert(wanted, x, self._limits).u
        self._commands.add(t_ns, u)
        return u

    def inject(self, t_ns: int, u: FloatArray, excitation: FloatArray) -> FloatArray:
        """Return the command `u` of `t_ns` with an excitation on top, within the limits.

        The observer is told: what is injected is no disturbance.
        """
        if not excitation.any():
            return u
        u = np.clip(u + excitation, *self._limits)
        self._commands.add(t_ns, u)
        return u


class ControllerExample(Node):
    """Rates and references in, commands out; one command for each Imu message."""

    def __init__(self) -> None:
        super().__init__("controller")
        value = self._declare()
        self._trim = np.array(value["trim"])
        limits = np.array([value["least"], value["largest"]]) - self._trim
        self._law = RateLaw(limits, value["delay"])
        fixed = value["mode"] == "fixed"
        self._source = CoefficientSource(
            Fallback.NOMINAL if fixed else Fallback(value["fallback"]),
            Coefficients.from_file(value["nominal_file"]) if value["nominal_file"] else None,
            heed_verdict=value["heed_verdict"],
            delay=value["coefficients_delay"],
        )
        if not fixed:
            subscribe(self, self._source)
        self._excitation = Excitation(value["excitation_limit"])
        subscribe_excitation(self, self._excitation)
        self._references: History[FloatArray] = History()
        self._reference_delay_ns = round(value["reference_delay"] * 1e9)
        self._reported = (0, "")
        best_effort = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._commands = self.create_publisher(JointState, "command", 50)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(Vector3Stamped, "rate_reference", self._on_reference, 50)
        self.create_subscription(Imu, "imu/data", self._on_imu, best_effort)

    def _declare(self) -> dict[str, Any]:
        return {
            name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()
        }

    def _on_reference(self, message: Vector3Stamped) -> None:
        vector = message.vector
        self._references.add(_ns(message.header), np.array([vector.x, vector.y, vector.z]))

    def _on_imu(self, message: Imu) -> None:
        t_ns = _ns(message.header)
        rates = message.angular_velocity
        x = np.array([rates.x, rates.y, rates.z]) * FLU_TO_FRD
        reference = self._references.at(t_ns - self._reference_delay_ns)
        try:
            model = self._source.model(t_ns)
            u = self._law.update(t_ns, model, x, np.zeros(3) if reference is None else reference)
            u = self._law.inject(t_ns, u, self._excitation.at(t_ns))
            why = self._source.refusal(t_ns)
            self._report(message.header, model.source, why, model)
        except Refusal as refusal:
            u = np.zeros(4)  # trim: all that is left
            self._report(message.header, "trim", str(refusal))
        raw = self._trim + u  # plain channels; others: raw = trim + pinv(mixing) u / scale
        self._commands.publish(
            JointState(
                header=message.header,
                name=["elevator", "rudder", "aileron"],
                position=raw[:3].tolist(),
            )
        )

    def _report(
        self, header: Header, source: str, why: str, model: AttitudeModel | None = None
    ) -> None:
        """Say what the loop flies on: when it changes in the log, and on /diagnostics."""
        line = f"flying on {source} coefficients" + (f": {why}" if why else "")
        t_ns = _ns(header)
        last_ns, said = self._reported
        if line == said and 0 <= t_ns - last_ns < REPORT_PERIOD * 1e9:
            return
        if line != said and why:
            self.get_logger().warning(line)
        elif line != said:
            self.get_logger().info(line)
        self._reported = (t_ns, line)
        level = DiagnosticStatus.WARN if why else DiagnosticStatus.OK
        values = (
            []
            if model is None
            else [
                KeyValue(key="from the fallback", value=", ".join(model.replaced) or "none"),
                KeyValue(key="left out", value=", ".join(model.left_out) or "none"),
            ]
        )
        name = self.get_fully_qualified_name()
        status = DiagnosticStatus(level=level, name=name, message=line, values=values)
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))


def _ns(header: Header) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def main(args: list[str] | None = None) -> int:
    """Run the node; the return value is the exit status."""
    usage = node_usage("controller_example", __doc__ or "", PARAMETERS)
    argv = sys.argv if args is None else args
    return run(
        "controller_example", ControllerExample, spin, argv=argv, ending=Ending(), usage=usage
    )


if __name__ == "__main__":
    sys.exit(main())
