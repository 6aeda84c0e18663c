# SPDX-License-Identifier: Apache-2.0
"""The reference rates lead to the commanded attitude."""

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the reference is a ROS node")

import rclpy
from geometry_msgs.msg import Quaternion, Vector3Stamped
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from uav_ident_ros.identification.frames import quaternions
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.ros import to_stamp
from uav_ident_ros.simulation.flight import EPOCH_NS
from uav_ident_ros.simulation.rate_reference import (
    MAX_RATES,
    Manoeuvres,
    RateReference,
    attitude,
    body_rates,
)

DT = 0.01


def test_ideal_tracking_reaches_both_banks_within_the_limits() -> None:
    bank, pitch = 0.5, 0.1
    manoeuvres = Manoeuvres(bank, pitch, (2.0, 4.0), 53.0, seed=3)
    roll, theta, flown = 0.0, 0.02, []
    for k in range(6000):
        rates = manoeuvres.rates(k * DT, roll, theta, DT)
        p, q, r = rates
        # kinematics of the Euler angles
        roll += DT * (p + math.tan(theta) * (q * math.sin(roll) + r * math.cos(roll)))
        theta += DT * (q * math.cos(roll) - r * math.sin(roll))
        flown.append((roll, theta, p))
    rolls, pitches, ps = np.array(flown).T
    assert rolls.max() > 0.3
    assert rolls.min() < -0.3
    assert np.abs(rolls).max() <= bank
    assert np.abs(pitches - 0.02).max() <= pitch
    assert np.abs(ps).max() < 1.2 * MAX_RATES[0]


def test_a_steady_turn_has_the_rates_of_a_coordinated_turn() -> None:
    roll, airspeed = 0.5, 53.0
    turn = GRAVITY / airspeed * math.tan(roll)
    p, q, r = body_rates(np.zeros(2), roll, 0.0, turn)
    assert p == pytest.approx(0.0)
    # heading rate psi' = (q sin + r cos) / cos(pitch); pitch rate q cos - r sin = 0
    assert q * math.sin(roll) + r * math.cos(roll) == pytest.approx(turn)
    assert q * math.cos(roll) - r * math.sin(roll) == pytest.approx(0.0)


@pytest.mark.parametrize("angles", [(0.3, -0.2, 1.0), (-1.2, 0.7, -3.0), (0.0, 0.0, 0.0)])
def test_roll_and_pitch_follow_from_the_quaternion(angles: tuple[float, float, float]) -> None:
    roll, pitch, yaw = angles
    turned = quaternions(roll, -pitch, 0.5 * math.pi - yaw)
    q = Quaternion(**dict(zip("xyzw", turned.tolist(), strict=True)))
    assert attitude(q) == pytest.approx((roll, pitch))
    assert q.w**2 + q.x**2 + q.y**2 + q.z**2 == pytest.approx(1.0)


def test_a_new_flight_has_its_manoeuvres_from_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stamps go back, as those of a plant that is started again."""
    sent: list[Vector3Stamped] = []
    rclpy.init(args=[])
    node = RateReference()
    monkeypatch.setattr(node._publisher, "publish", sent.append)
    for k in (*range(400), *range(400)):
        node._on_imu(Imu(header=Header(stamp=to_stamp(EPOCH_NS + k * round(DT * 1e9)))))
    node.destroy_node()
    rclpy.shutdown()
    assert sent[:400] == sent[400:]
    assert sent[399].vector.x != 0.0
