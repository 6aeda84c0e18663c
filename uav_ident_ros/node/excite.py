# SPDX-License-Identifier: Apache-2.0
"""The service ``~/excite`` and the topic ``~/excitation``."""

import math
import time
from collections.abc import Iterator

from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.excitation_run import ExcitationRun, Injection
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import EXCITATION_TIMEOUT
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.messages.types import NS_PER_S
from uav_ident_ros.ros import RELIABLE, to_stamp

STALE = 0.5
"""Time without a tick after which a run is aborted, s: ten at 20 Hz. It must pass on the node's
clock and on a steady clock: a simulation's /clock may run ahead of its Imu, or stand still."""

SAMPLES_PER_CYCLE = 4.0
"""Ticks needed in a cycle of the highest frequency."""

LOWEST_RATE = 2.0 / EXCITATION_TIMEOUT
"""Rate of ticks, Hz, below which one lost message would reach `EXCITATION_TIMEOUT`."""


def slowest_ticks(highest: float) -> float:
    """Return the least rate of ticks, Hz, for signals up to a frequency, Hz."""
    return max(LOWEST_RATE, SAMPLES_PER_CYCLE * highest)


class Excite:
    """Starts and ends runs of excitation, and publishes their signals."""

    def __init__(
        self,
        node: Node,
        identifier: OnlineIdentifier,
        injected: Subscription,  # Of the topic `excitation`, by which others publish a signal
    ) -> None:
        self._identifier, self._injected = identifier, injected
        self._log = node.get_logger()
        self._clock = node.get_clock()
        self._publisher = node.create_publisher(JointState, "~/excitation", RELIABLE)
        self._run = ExcitationRun(identifier.structure)
        self._ticked = (0, 0.0)  # time of the last tick by the node's clock, ns, and the steady, s
        self._estimate: Estimate | None = None

    def request(self, wanted: bool) -> tuple[bool, str]:
        """Start a run, or abort it; return the success and a message."""
        if not wanted:
            self.abort("asked for")
            return True, "excitation is zero"
        problem = self._start()
        return not problem, f"not started: {problem}" if problem else "excitation is running"

    def _start(self) -> str:
        estimate = self._estimate
        if estimate is None or self._stale():
            return "there are no ticks: rates or actuators do not arrive"
        settings, rate = self._identifier.settings.excitation, self._identifier.settings.update_rate
        needed = slowest_ticks(settings.band[1])
        if rate < needed:
            return (
                f"'update_rate' is {rate:g} Hz: signals up to {settings.band[1]:g} Hz "
                f"('excitation.band') need {needed:g} Hz"
            )
        return self._run.start(settings, self._identifier.flying(), estimate)

    def tick(self, estimate: Estimate) -> None:
        """Publish the excitation after a tick."""
        self._ticked, self._estimate = (self._now_ns(), time.monotonic()), estimate
        before = self._run.active
        injection = self._run.step(self._identifier.flying(), estimate)
        if injection is not None:
            self._publish(injection)
        if before and not self._run.active:
            self._log_end()

    def watch(self) -> None:
        """Abort the run if ticks stop; to be called at the rate of the ticks."""
        if self._run.active and self._stale():
            self.abort("no ticks any more: rates or actuators do not arrive")

    def abort(self, why: str) -> None:
        """Publish zero and end the run; without a run, do nothing."""
        if not self._run.active:
            return
        assert self._estimate is not None  # a run has begun at a tick
        t_ns = self._identifier.intake.newest_ns or self._estimate.t_ns  # none after a restart
        self._publish(self._run.abort(t_ns, f"aborted: {why}"))
        self._log_end()

    def values(self) -> Iterator[tuple[str, str]]:
        """Yield the state of the run for /diagnostics, each value with its label."""
        run, sufficiency = self._run, self._run.sufficiency
        yield "state", run.phase.value
        yield "last run", run.why or "none yet"
        if sufficiency is None:
            return
        if run.active:
            yield "elapsed [s]", f"{run.elapsed:.1f}"
            yield "remaining [s]", f"{run.remaining:.1f}"
            left = sufficiency.time_left
            yield "until known [s]", f"{left:.0f}" if math.isfinite(left) else "unknown"
        yield "not known yet", ", ".join(sufficiency.unknown) or "nothing"
        for name, (coefficient, value, sigma) in sufficiency.effects.items():
            yield f"effect of {name}", f"{coefficient} = {value:.3g} +- {sigma:.2g}"

    def _log_end(self) -> None:
        self._log.info(f"excitation: {self._run.why}")

    def _stale(self) -> bool:
        clock_ns, steady = self._ticked
        return self._now_ns() - clock_ns > STALE * NS_PER_S and time.monotonic() - steady > STALE

    def _now_ns(self) -> int:
        return int(self._clock.now().nanoseconds)

    def _publish(self, injection: Injection) -> None:
        values = injection.values.tolist()
        # With a publisher of the injected signal the identifier hears of it from there. The
        # subscription knows its publishers, without a query of the graph.
        if not self._injected.get_publisher_count():
            self._identifier.add_excitation(injection.t_ns, values, own=True)
        header = Header(stamp=to_stamp(injection.t_ns))
        self._publisher.publish(JointState(header=header, name=list(INPUTS), position=values))
