# SPDX-License-Identifier: Apache-2.0
"""Messages of the common interfaces from plain values, for bags to be written."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uav_ident_ros.bags.writing import message_class, stamp
from uav_ident_ros.identification.structure import FloatArray

IMU, JOINT_STATE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
VECTOR, TWIST = "geometry_msgs/msg/Vector3Stamped", "geometry_msgs/msg/TwistStamped"

NOT_MEASURED, UNKNOWN = np.array([-1.0, *[0.0] * 8]), np.zeros(9)
"""Covariances of an Imu that say that there is no such measurement, or that it is not known."""

NO_TURN = (0.0, 0.0, 0.0, 1.0)
EMPTY = np.zeros(0)


def header(t_ns: int, frame_id: str = "") -> Any:
    """std_msgs/msg/Header."""
    return message_class("std_msgs/msg/Header")(stamp=stamp(t_ns), frame_id=frame_id)


def vector(x: float, y: float, z: float) -> Any:
    """geometry_msgs/msg/Vector3."""
    return message_class("geometry_msgs/msg/Vector3")(x, y, z)


def imu(
    t_ns: int,
    rates: Sequence[float],  # Angular velocity, rad/s
    force: Sequence[float] | None,  # Specific force, m/s^2; None if it is not measured
    frame_id: str = "",
    orientation: Sequence[float] | None = None,  # x, y, z, w; None if it is not measured
    covariances: tuple[FloatArray, FloatArray] = (UNKNOWN, UNKNOWN),  # of rates and force
) -> Any:
    """sensor_msgs/msg/Imu."""
    return message_class(IMU)(
        header=header(t_ns, frame_id),
        orientation=message_class("geometry_msgs/msg/Quaternion")(*(orientation or NO_TURN)),
        orientation_covariance=UNKNOWN if orientation else NOT_MEASURED,
        angular_velocity=vector(*rates),
        angular_velocity_covariance=covariances[0],
        linear_acceleration=vector(*(force or NO_TURN[:3])),
        linear_acceleration_covariance=covariances[1] if force else NOT_MEASURED,
    )


def joint_state(
    t_ns: int, names: Sequence[str], positions: ArrayLike, efforts: ArrayLike = EMPTY
) -> Any:
    """sensor_msgs/msg/JointState."""
    numbers = (np.ascontiguousarray(part, dtype=float) for part in (positions, EMPTY, efforts))
    return message_class(JOINT_STATE)(header(t_ns), list(names), *numbers)


def array(values: ArrayLike, dimensions: Sequence[tuple[str, int, int]] = ()) -> Any:
    """std_msgs/msg/Float64MultiArray."""
    dimension = message_class("std_msgs/msg/MultiArrayDimension")
    layout = message_class("std_msgs/msg/MultiArrayLayout")
    dim = [dimension(*words) for words in dimensions]
    return message_class(ARRAY)(layout(dim, data_offset=0), np.ascontiguousarray(np.ravel(values)))


def vector_stamped(t_ns: int, xyz: Sequence[float], frame_id: str = "") -> Any:
    """geometry_msgs/msg/Vector3Stamped."""
    return message_class(VECTOR)(header(t_ns, frame_id), vector(*xyz))


def twist_stamped(t_ns: int, linear: Sequence[float]) -> Any:
    """geometry_msgs/msg/TwistStamped of something that does not turn."""
    twist = message_class("geometry_msgs/msg/Twist")(vector(*linear), vector(0.0, 0.0, 0.0))
    return message_class(TWIST)(header(t_ns), twist)


def plain(msgtype: str, data: float | bool | str) -> Any:
    """Return a message of std_msgs with one field, `data`."""
    return message_class(msgtype)(data=data)
