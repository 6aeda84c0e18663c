# SPDX-License-Identifier: Apache-2.0
"""Writer of rosbag2 bags in MCAP, with schemas and QoS; equal messages give equal bytes."""

from __future__ import annotations

import dataclasses
import heapq
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import NS_PER_S

FOREVER = QosTime(2147483647, 4294967295)
"""Infinite duration, as rosbag2 writes it."""


class BagWriteError(Exception):
    """A bag cannot be written; the message names the path or topic and the reason."""


@contextmanager
def whole(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield a temporary path for a file or a folder, which replaces `path` on success.

    No partial output remains. Missing parent folders are made.

    Raises
    ------
    BagWriteError
        If `path` cannot be written, or is an existing folder without `replace`.
    """
    if path.is_dir() and not replace:
        raise BagWriteError(f"{path} exists already, not overwriting.")
    working = path.parent / f".{path.name}.part"
    shutil.rmtree(working, ignore_errors=True)
    try:
        working.mkdir(parents=True)
        yield working / path.name
        if path.is_dir():
            shutil.rmtree(path)
        (working / path.name).replace(path)
    except OSError as error:
        raise BagWriteError(f"cannot write '{path}': {error.strerror}") from None
    finally:
        shutil.rmtree(working, ignore_errors=True)


def write_file(path: Path, text: str) -> None:
    """Write a text file, whole or not at all; raises `BagWriteError`."""
    with whole(path) as part:
        part.write_text(text, encoding="utf-8")


def qos(depth: int = 10, *, reliable: bool = True, transient_local: bool = False) -> Qos:
    """Return the QoS profile of a topic: reliable or best effort, latched or not."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if transient_local else QosDurability.VOLATILE,
        deadline=FOREVER,
        lifespan=FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=FOREVER,
        avoid_ros_namespace_conventions=False,
    )


@cache
def jazzy_types() -> Typestore:
    """Return the message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def message_class(msgtype: str) -> Any:
    """Return the class of a message type such as ``sensor_msgs/msg/Imu``."""
    return jazzy_types().types[msgtype]


def stamp(t_ns: int) -> Any:
    """Return a builtin_interfaces/msg/Time from a time in ns."""
    return message_class("builtin_interfaces/msg/Time")(
        sec=int(t_ns) // NS_PER_S, nanosec=int(t_ns) % NS_PER_S
    )


class BagWriter:
    """Writer of a new rosbag2 folder with an MCAP file, optionally in zstd; a context manager.

    Messages are written in the order of the calls; give them in log-time order. A block that ends
    with an exception leaves the bag without metadata, like an interrupted recording.

    Examples
    --------
    >>> with BagWriter("flight") as bag:                                  # doctest: +SKIP
    ...     bag.topic("/data", "std_msgs/msg/Float64MultiArray", qos=qos(10))
    ...     bag.write("/data", 0, message)
    """

    def __init__(self, path: Path | str, compress: bool = False) -> None:
        self.path = Path(path)
        self._topics: dict[str, Connection] = {}
        self._writer = Writer(
            self.path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP
        )
        if compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def __enter__(self) -> BagWriter:
        """Create the folder and open the file."""
        self._writer.open()
        return self

    def __exit__(self, *error: Any) -> None:
        """Write index and metadata; after an exception leave the bag unfinished."""
        self._writer.__exit__(*error)

    def topic(self, name: str, msgtype: str, qos: Qos | None = None) -> None:
        """Add a topic of a type, ``package/msg/Name``, and the QoS profile of its publisher."""
        self._topics[name] = self._writer.add_connection(
            name, msgtype, typestore=jazzy_types(), offered_qos_profiles=(qos,) if qos else ()
        )

    def write(self, topic: str, log_time_ns: int, message: Any) -> None:
        """Write a message on an added topic: a dataclass (`message_class`), or CDR bytes."""
        connection = self._topics[topic]
        if dataclasses.is_dataclass(message):
            message = jazzy_types().serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, int(log_time_ns), message)

    def merge(self, streams: Iterable[Iterable[tuple[int, str, Any]]]) -> None:
        """Write the messages of several streams, each sorted by log time, in log-time order.

        At equal times the earlier stream comes first: actuators before rates, as the command
        precedes its effect. Each message has log time (ns), topic and message, as in `write`.
        """
        for log_ns, topic, message in heapq.merge(*streams, key=itemgetter(0)):
            self.write(topic, log_ns, message)


# --- messages of the common interfaces from plain values ------------------------------------------


IMU, JOINT_STATE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
VECTOR, TWIST = "geometry_msgs/msg/Vector3Stamped", "geometry_msgs/msg/TwistStamped"

NOT_MEASURED, NOT_KNOWN = np.array([-1.0, *[0.0] * 8]), np.zeros(9)
"""Covariances of an Imu: no such measurement, and unknown covariance."""

NO_TURN = (0.0, 0.0, 0.0, 1.0)
EMPTY = np.zeros(0)


def header(t_ns: int, frame_id: str = "") -> Any:
    """Return a std_msgs/msg/Header."""
    return message_class("std_msgs/msg/Header")(stamp=stamp(t_ns), frame_id=frame_id)


def vector(x: float, y: float, z: float) -> Any:
    """Return a geometry_msgs/msg/Vector3."""
    return message_class("geometry_msgs/msg/Vector3")(x, y, z)


def imu(
    t_ns: int,
    rates: Sequence[float],  # Angular velocity, rad/s
    force: Sequence[float] | None,  # Specific force, m/s^2; None if it is not measured
    frame_id: str = "",
    orientation: Sequence[float] | None = None,  # x, y, z, w; None if it is not measured
    covariances: tuple[FloatArray, FloatArray] = (NOT_KNOWN, NOT_KNOWN),  # of rates and force
) -> Any:
    """Return a sensor_msgs/msg/Imu."""
    return message_class(IMU)(
        header=header(t_ns, frame_id),
        orientation=message_class("geometry_msgs/msg/Quaternion")(*(orientation or NO_TURN)),
        orientation_covariance=NOT_KNOWN if orientation else NOT_MEASURED,
        angular_velocity=vector(*rates),
        angular_velocity_covariance=covariances[0],
        linear_acceleration=vector(*(force or NO_TURN[:3])),
        linear_acceleration_covariance=covariances[1] if force else NOT_MEASURED,
    )


def joint_state(
    t_ns: int, names: Sequence[str], positions: ArrayLike, efforts: ArrayLike = EMPTY
) -> Any:
    """Return a sensor_msgs/msg/JointState."""
    numbers = (np.ascontiguousarray(part, dtype=float) for part in (positions, EMPTY, efforts))
    return message_class(JOINT_STATE)(header(t_ns), list(names), *numbers)


def array(values: ArrayLike, dimensions: Sequence[tuple[str, int, int]] = ()) -> Any:
    """Return a std_msgs/msg/Float64MultiArray."""
    dimension = message_class("std_msgs/msg/MultiArrayDimension")
    layout = message_class("std_msgs/msg/MultiArrayLayout")
    dim = [dimension(*entry) for entry in dimensions]
    return message_class(ARRAY)(layout(dim, data_offset=0), np.ascontiguousarray(np.ravel(values)))


def vector_stamped(t_ns: int, xyz: Sequence[float], frame_id: str) -> Any:
    """Return a geometry_msgs/msg/Vector3Stamped."""
    return message_class(VECTOR)(header(t_ns, frame_id), vector(*xyz))


def twist_stamped(t_ns: int, linear: Sequence[float]) -> Any:
    """Return a geometry_msgs/msg/TwistStamped without rotation."""
    twist = message_class("geometry_msgs/msg/Twist")(vector(*linear), vector(0.0, 0.0, 0.0))
    return message_class(TWIST)(header(t_ns), twist)


def plain(msgtype: str, data: float | bool | str) -> Any:
    """Return a message of std_msgs with one field, `data`."""
    return message_class(msgtype)(data=data)
