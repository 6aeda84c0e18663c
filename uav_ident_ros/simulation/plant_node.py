# SPDX-License-Identifier: Apache-2.0
"""The node `simulated_plant`: a JSBSim aircraft for controllers to fly.

It publishes the Imu, the airspeed of an aeroplane and the actuator commands, and receives commands.
In lock-step (``lock_step``) it publishes /clock and waits for the command to each Imu sample. Such
a flight is the same on any machine, and as fast as the loop allows. Otherwise the node flies in
real time, stamped with the wall clock, without waiting.
"""

import contextlib
import math
import sys
import time
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Quaternion, Twist, TwistStamped, Vector3, Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool

from uav_ident_ros.client import (
    Coefficients,
    CoefficientSource,
    Excitation,
    Fallback,
    subscribe,
    subscribe_excitation,
)
from uav_ident_ros.guest import StepClock, listen
from uav_ident_ros.identification.frames import quaternions
from uav_ident_ros.identification.settings import Setting
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import FLU_TO_FRD, FRAME_IDS, NS_PER_S, header_ns, xyz
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.node.program import UsageError, read_parameters, run
from uav_ident_ros.ros import to_stamp
from uav_ident_ros.simulation.faults import Fault, parse_fault
from uav_ident_ros.simulation.flight import EPOCH_NS, SimulationError
from uav_ident_ros.simulation.jsbsim_flight import LiveAircraft
from uav_ident_ros.simulation.live import Live, Sample
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.quadrotor_flight import NAME as QUADROTOR
from uav_ident_ros.simulation.quadrotor_flight import LiveQuadrotor

PATIENCE = 5.0
"""In lock-step: longest wait for a command or service, wall-clock seconds."""

START_PATIENCE = 60.0
"""Longest wait for the other nodes at the start, wall-clock seconds."""

COEFFICIENTS_WITHIN_NS = 200_000_000
"""In lock-step: largest age of the newest coefficients at the newest Imu sample, ns."""

TICK_NS = TICK_DUE_NS = 50_000_000
"""Period of the ticks, and age of a tick at the newest Imu sample when it is due, ns."""

QUEUE = 50
"""Depth of the queues, all reliable: lock-step needs every message."""

PARAMETERS = (
    Setting("aircraft", "str", "c172p", "",
        '"quadrotor", or an aircraft of uav_ident_ros/simulation/airframes, or its file.'),
    Setting("speed", "float", 0.0, "m/s", "True airspeed; 0 for the airframe's.", 0.0),
    Setting("rate", "float", 100.0, "Hz", "Rate of the Imu and of the commands."),
    Setting("delay", "float", 0.02, "s",
        "From the stamp of a sample to the action of its command on the surface."),
    Setting("gyro_noise", "float", 0.005, "rad/s", "Rms noise of a sample."),
    Setting("gyro_bias", "float[]", (0.002, -0.001, 0.001), "rad/s", "Bias of p, q, r, FRD."),
    Setting("accelerometer_noise", "float", 0.05, "m/s^2", "Rms noise of a sample."),
    Setting("airspeed_noise", "float", 0.3, "m/s", "Rms noise; below 0: no sensor."),
    Setting("airspeed_bias", "float", 0.3, "m/s", "Constant error."),
    Setting("seed", "int", 0, "", "Seed of noise and turbulence.", 0.0),
    Setting("duration", "float", 0.0, "s", "Length of the flight; 0: no end.", 0.0),
    Setting("lock_step", "bool", True, "", "Fly in lock-step, or in real time."),
    Setting("excite_at", "float", 0.0, "s",
        "Time of the request for excitation; 0: none.", 0.0),
    Setting("faults", "str[]", ("",), "",
        "As in uav_ident_ros/simulation/faults.py, with times."),
    Setting("wait_for_identifier", "bool", True, "", "In lock-step: wait for coefficients."),
    Setting("wait_for_reference", "bool", False, "",
        "In lock-step: wait for rate_reference before the first sample."),
    Setting("record_file", "str", "", "",
        "NumPy archive of the flight, written at the end; touched at every sample."),
)  # fmt: skip

RECORDED = (
    # A row for each Imu sample: s; true rates, those of the gyro and of the reference (NaN before
    # the first), rad/s, FRD; roll, pitch, yaw, rad
    "time", "rates", "measured", "reference", "attitude",
    # elevator, rudder, aileron, rad, and throttle: commanded, and true; requested excitation of de,
    # dr, da, dth
    "outputs", "surfaces", "excitation",
    # A row for each received estimate: s; by name; and the verdict
    "tick", "values", "sigma", "fit", "usable",
    "names",  # of the coefficients
    "lost",  # Time of the loss of the aircraft, s, or NaN
)  # fmt: skip
"""Arrays of the record."""


class PlantNode(Node):
    """The node: an aircraft, its messages, and its synchronisation with the other nodes."""

    def __init__(self) -> None:
        super().__init__("simulated_plant")
        self._ending: Ending  # Recorder of signals, from `fly` on
        self._value = value = read_parameters(self, PARAMETERS)
        unchanged = ("rate", "gyro_noise", "accelerometer_noise", "airspeed_bias")
        sensors = Sensors(
            gyro_bias=tuple(value["gyro_bias"]),
            airspeed_noise=noise if (noise := value["airspeed_noise"]) >= 0.0 else None,
            **{name: value[name] for name in unchanged},
        )
        faults = [parse_fault(text) for text in value["faults"] if text]
        flown = sensors, value["delay"], faults, value["seed"]
        self._aircraft: Live
        if value["aircraft"] == QUADROTOR:
            self._aircraft = LiveQuadrotor(*flown)
        else:
            self._aircraft = LiveAircraft(value["aircraft"], *flown, value["speed"] or None)
        self._lock_step: bool = value["lock_step"]
        self._period_ns = round(NS_PER_S / value["rate"])
        self._now_ns = self._start_ns = EPOCH_NS
        self._record: dict[str, list[Any]] = {name: [] for name in RECORDED}
        # Newest command and reference: stamp, ns, and value
        self._command: tuple[int, FloatArray | None] = (0, None)
        self._reference = (0, np.full(3, np.nan))
        self._coefficients_ns = 0
        self._identifier_silent = not value["wait_for_identifier"]
        self._controller_silent = False
        self.missed = 0
        self._excite_at: float = value["excite_at"] or math.inf
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._clock = StepClock(self, self._executor, self._period_ns, self._lock_step)
        self._imu = self.create_publisher(Imu, "imu/data", QUEUE)
        self._actuators = self.create_publisher(JointState, "actuators", QUEUE)
        self._airspeed = self.create_publisher(TwistStamped, "airspeed", QUEUE)
        self.create_subscription(JointState, "command", self._on_command, QUEUE)
        self.create_subscription(Vector3Stamped, "rate_reference", self._on_reference, QUEUE)
        self.create_subscription(String, "~/fault", self._on_fault, QUEUE)
        self._excite = self.create_client(SetBool, "identifier/excite")
        refusing = CoefficientSource(Fallback.REFUSE)
        self._identified = subscribe(self, refusing, callback=self._on_coefficients)
        self._requests = Excitation([math.inf] * 4)
        subscribe_excitation(self, self._requests)

    def _going(self) -> bool:
        return rclpy.ok() and not self._ending.requested

    # -- messages in -----------------------------------------------------------------------

    def _on_command(self, message: JointState) -> None:
        surfaces = np.array(message.position[:3])
        if surfaces.shape == (3,) and np.isfinite(surfaces).all():
            self._command = max((header_ns(message), surfaces), self._command, key=itemgetter(0))
            self._controller_silent = False
        else:
            self.get_logger().error(
                f"command {list(message.position)}: elevator, rudder and aileron are wanted, rad"
            )

    def _on_reference(self, message: Vector3Stamped) -> None:
        self._reference = header_ns(message), np.array(xyz(message.vector))

    def _on_coefficients(self, coefficients: Coefficients) -> None:
        if self._identifier_silent and self._value["wait_for_identifier"]:
            self.get_logger().info("the identifier is back")
            self._identifier_silent = False
        self._coefficients_ns = coefficients.t_ns
        there = coefficients.structure.mask
        self._record["names"] = list(coefficients.names)
        self._keep(
            tick=(coefficients.t_ns - self._start_ns) / NS_PER_S,
            usable=coefficients.usable,
            fit=coefficients.fit,
            values=coefficients.values[there],
            sigma=coefficients.sigma[there],
        )

    def _keep(self, **row: Any) -> None:
        for name, value in row.items():
            self._record[name].append(value)

    def _on_fault(self, message: String) -> None:
        try:
            fault = parse_fault(message.data)
            if math.isfinite(fault.time):
                raise SimulationError(f"fault '{message.data}': on the topic it happens at once")
            self._aircraft.apply(fault)
            self._log_fault(fault)
        except SimulationError as error:
            self.get_logger().error(str(error))

    def _log_fault(self, fault: Fault) -> None:
        self.get_logger().warning(f"fault at {self._aircraft.time:.2f} s: {fault}")

    # -- flying ----------------------------------------------------------------------------

    def fly(self, ending: Ending) -> None:
        """Fly until `duration` is over or the end is requested."""
        self._ending = ending
        if self._lock_step:
            self._wait_for_nodes()
        else:
            self._start_ns = time.time_ns()
        began = time.monotonic()
        duration = self._value["duration"] or math.inf
        self._record["lost"] = [math.nan]
        try:
            while self._going() and self._aircraft.time < duration:
                self._one_interval(began)
                self._show_progress()
        except SimulationError:
            self._record["lost"] = [self._aircraft.time]
            raise
        finally:
            self._save_record()
        speed = self._aircraft.time / (time.monotonic() - began)
        self.get_logger().info(
            f"flew {self._aircraft.time:.1f} s at {speed:.1f} times real time; "
            f"{self.missed} samples without an answer"
        )

    def _show_progress(self) -> None:
        """Touch the record's file: who waits for it sees that the flight goes on."""
        if path := self._value["record_file"]:
            with contextlib.suppress(OSError):  # `_save_record` reports it
                Path(path).touch()

    def _save_record(self) -> None:
        if path := self._value["record_file"]:
            columns = {name: np.array(rows) for name, rows in self._record.items()}
            try:
                np.savez_compressed(path, **columns)
            except OSError as error:
                self.get_logger().error(f"cannot write '{path}': {error.strerror}")

    def _one_interval(self, began: float) -> None:
        self._now_ns = self._start_ns + round(self._aircraft.time * NS_PER_S)
        sample = self._aircraft.sample()
        self._clock.advance(self._now_ns)
        if (speed := sample.measured_airspeed) is not None:
            header, along = Header(stamp=to_stamp(self._now_ns)), Vector3(x=float(speed))
            self._airspeed.publish(TwistStamped(header=header, twist=Twist(linear=along)))
        self._imu.publish(_imu_message(self._now_ns, sample))
        if self._lock_step:
            self._wait_for_answers()
        self._excite_if_due()
        if not self._lock_step:
            end = began + (self._now_ns + self._period_ns - self._start_ns) / NS_PER_S
            self._wait(lambda: False, end - time.monotonic())
        self._answer(sample)
        for fault in self._aircraft.advance():
            self._log_fault(fault)

    def _answer(self, sample: Sample) -> None:
        """Command the actuators, publish their commands and record the sample."""
        t_ns, surfaces = self._command
        self.missed += t_ns < self._now_ns
        self._aircraft.command(surfaces)
        outputs = self._aircraft.outputs
        self._actuators.publish(
            JointState(
                header=Header(stamp=to_stamp(self._now_ns)),
                name=list(self._aircraft.names),
                position=outputs.tolist(),
            )
        )
        self._keep(
            time=sample.time,
            rates=sample.rates,
            measured=sample.measured_rates,
            attitude=sample.attitude,
            surfaces=sample.surfaces,
            outputs=outputs,
            reference=self._reference[1],
            excitation=self._requests.at(self._now_ns),
        )

    def _excite_if_due(self) -> None:
        """Request excitation once; in lock-step, at the same tick in every flight."""
        if self._aircraft.time < self._excite_at:
            return
        self._excite_at = math.inf
        if self._lock_step:
            self._wait_for_coefficients((self._now_ns - TICK_DUE_NS) // TICK_NS * TICK_NS)
        answer = self._excite.call_async(SetBool.Request(data=True))
        answer.add_done_callback(lambda future: self._log_answer(future.result()))
        if self._lock_step and not self._wait(answer.done, PATIENCE):
            self.get_logger().error(f"excite: no answer within {PATIENCE:g} s")

    def _log_answer(self, answer: Any) -> None:
        self.get_logger().info(f"excite at {self._aircraft.time:.2f} s: {answer.message}")

    # -- waiting ---------------------------------------------------------------------------

    def _wait(self, condition: Callable[[], bool], patience: float) -> bool:
        listen(self._executor, patience, lambda: condition() or not self._going())
        return condition()

    def _wait_for_nodes(self) -> None:
        """Spin until the controller, and the nodes that the parameters name, are discovered.

        A controller in lock-step advertises its commands once it has discovered the identifier.
        """
        guided, identified = bool(self._value["wait_for_reference"]), not self._identifier_silent
        clock = self._clock.publisher
        assert clock is not None, "only in step"

        def missing() -> list[str]:
            there = {
                "a controller on 'command'": self.count_publishers("command") > 0,
                "a rate_reference": not guided or self.count_publishers("rate_reference") > 0,
                "an identifier": not identified
                or (
                    self._identified.get_publisher_count() > 0
                    and clock.get_subscription_count() > 0
                    and self._actuators.get_subscription_count() > 0
                ),
                "listeners to 'imu/data'": self._imu.get_subscription_count() > guided + identified,
            }
            return [what for what, ready in there.items() if not ready]

        if not self._wait(lambda: not missing(), START_PATIENCE) and self._going():
            raise SimulationError(
                f"waited {START_PATIENCE:g} s in vain for {' and '.join(missing())}"
            )
        self._wait(lambda: False, 1.0)  # until the other nodes have discovered this one, too

    def _wait_for_answers(self) -> None:
        """Spin until the command to the newest sample and recent coefficients have arrived."""
        unguided = not self._value["wait_for_reference"]

        def answered() -> bool:
            referred_ns = self._reference[0]
            guided = referred_ns >= self._now_ns or (unguided and not referred_ns)
            return guided and self._command[0] >= self._now_ns

        if not self._controller_silent and not self._wait(answered, PATIENCE) and self._going():
            self._controller_silent = True
            self.get_logger().error(
                f"no answer to the sample of {self._aircraft.time:.2f} s within {PATIENCE:g} "
                "s: the last command holds, going on without waiting"
            )
        wanted = self._now_ns - COEFFICIENTS_WITHIN_NS
        if not self._identifier_silent and wanted > self._start_ns + COEFFICIENTS_WITHIN_NS:
            self._wait_for_coefficients(wanted)

    def _wait_for_coefficients(self, wanted_ns: int) -> None:
        def answered() -> bool:
            return self._coefficients_ns >= wanted_ns or not self._going()

        if not self._clock.wait(answered, self._now_ns, PATIENCE):
            self._identifier_silent = True
            self.get_logger().warning(
                f"no coefficients any more at {self._aircraft.time:.2f} s: going on without"
            )


def _imu_message(t_ns: int, sample: Sample) -> Imu:
    """Return an Imu message in REP-103 axes, with the true orientation in place of an AHRS's."""
    message = Imu(header=Header(stamp=to_stamp(t_ns), frame_id=FRAME_IDS["flu"]))
    message.angular_velocity = _vector(sample.measured_rates * FLU_TO_FRD)
    message.linear_acceleration = _vector(sample.measured_force * FLU_TO_FRD)
    roll, pitch, yaw = sample.attitude.tolist()
    turned = quaternions(roll, -pitch, 0.5 * math.pi - yaw)
    message.orientation = Quaternion(**dict(zip("xyzw", turned.tolist(), strict=True)))
    return message


def _vector(values: FloatArray) -> Vector3:
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))


def main(args: list[str] | None = None) -> int:
    """Run the node; return the exit status, 2 for wrong parameters."""
    return run("simulated_plant", _make, _fly, args, __doc__, PARAMETERS)


def _make() -> PlantNode:
    try:
        return PlantNode()
    except SimulationError as error:
        raise UsageError(str(error)) from None


def _fly(node: PlantNode, ending: Ending) -> int:
    """Fly; return 1 if the aircraft is lost or a node that is waited for is missing."""
    try:
        node.fly(ending)
    except SimulationError as error:
        node.get_logger().error(str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
