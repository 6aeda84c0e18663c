# SPDX-License-Identifier: Apache-2.0
"""A controller adds excitation, and stops when no more of it comes."""

import time

import numpy as np
from programs import StartNode
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from uav_ident_ros.client import Excitation, subscribe_excitation
from uav_ident_ros.guest import Guest
from uav_ident_ros.identification.settings import EXCITATION_TIMEOUT, Settings
from uav_ident_ros.ros import to_stamp

SURFACES = ["elevator", "rudder", "aileron", "throttle"]
PERIOD_NS = 10_000_000
START_UP = 120.0
"""Seconds that a node may take to fly, on any machine."""


class Controller(Guest):
    """A controller that does nothing but to add the excitation, on the wall clock."""

    def __init__(self) -> None:
        super().__init__("controller")
        self._imu = self.node.create_publisher(Imu, "imu/data", 50)
        self._actuators = self.node.create_publisher(JointState, "actuators", 50)
        self.excitation = Excitation(limit=[0.1] * 4)
        subscribe_excitation(self.node, self.excitation)
        self.added: list[tuple[int, bool]] = []
        """When something else than zero was added, ns, and when not."""
        self._next_ns = time.time_ns()

    def fly_one_sample(self) -> None:
        """Publish a sample of quiet flight, and see what is to be added to the answer."""
        self._next_ns += PERIOD_NS
        self.spin_for((self._next_ns - time.time_ns()) * 1e-9)
        self._executor.spin_once(timeout_sec=0.0)
        header = Header(stamp=to_stamp(self._next_ns))
        imu = Imu(header=header)
        imu.linear_acceleration.z = 9.81
        imu.angular_velocity.x = 0.01 * float(np.sin(self._next_ns * 1e-9))
        self._imu.publish(imu)
        requested = self.excitation.at(self._next_ns)
        self.added.append((self._next_ns, bool(requested.any())))
        self._actuators.publish(
            JointState(header=header, name=SURFACES, position=requested.tolist())
        )


def test_a_killed_node_leaves_the_controller_at_zero(start_node: StartNode) -> None:
    node = start_node(
        parameters={
            "actuators.type": "sensor_msgs/msg/JointState",
            "actuators.channels": str(SURFACES),
            "state_file": "none",
            "excitation.fade_time": "0.0",
        }
    )
    controller = Controller()
    try:
        client = controller.node.create_client(SetBool, "identifier/excite")
        end = time.monotonic() + START_UP
        while not all(on for _, on in controller.added[-20:]) or len(controller.added) < 20:
            assert time.monotonic() < end, node.log
            # again and again: on a busy machine a run may be aborted, for want of samples
            if client.service_is_ready() and len(controller.added) % 50 == 0:
                client.call_async(SetBool.Request(data=True))
            controller.fly_one_sample()
        node.kill()
        node.wait()
        killed_ns = time.time_ns()
        for _ in range(100):
            controller.fly_one_sample()
    finally:
        controller.close()
    last_ns = max(t for t, on in controller.added if on)
    longest = Settings().excitation.lead + EXCITATION_TIMEOUT
    assert last_ns <= killed_ns + round(longest * 1e9)
    assert not any(on for _, on in controller.added[-20:])
