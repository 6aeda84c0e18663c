# SPDX-License-Identifier: Apache-2.0
"""Measured flights as bags: /imu/data and /actuators, and the parameters that fit them."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from uav_ident_ros.bags.writing import BagWriter, header, message_class, qos
from uav_ident_ros.files.truth_file import TRUTH_FILE
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES
from uav_ident_ros.simulation.noise import Measurements

IMU_TOPIC, IMU_TYPE = "/imu/data", "sensor_msgs/msg/Imu"
ACTUATOR_TOPIC = "/actuators"
STAMPED_TYPE, UNSTAMPED_TYPE = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"

NO_ORIENTATION = np.array([-1.0, *[0.0] * 8])
"""orientation_covariance of an Imu without orientation (sensor_msgs/Imu)."""

PARAMETER_FILE = "identifier.yaml"

FIGURES = 9
"""Significant figures of the numbers in the files beside the bag."""


def actuator_type(measurements: Measurements) -> str:
    """Message type of the actuator topic."""
    return STAMPED_TYPE if measurements.sensors.stamped else UNSTAMPED_TYPE


def imu_messages(measurements: Measurements) -> Iterator[tuple[int, str, Any]]:
    """(log time, topic, message) of every Imu message."""
    imu, vector = message_class(IMU_TYPE), message_class("geometry_msgs/msg/Vector3")
    quaternion = message_class("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0)
    sensors = measurements.sensors
    rate_covariance = np.diag([sensors.gyro_noise**2] * 3).ravel()
    force_covariance = np.diag([sensors.accelerometer_noise**2] * 3).ravel()
    columns = (
        measurements.imu_log_ns.tolist(),
        measurements.imu_t_ns.tolist(),
        measurements.rates.tolist(),
        measurements.specific_force.tolist(),
    )
    for log, t, rates, force in zip(*columns, strict=True):
        yield (
            log,
            IMU_TOPIC,
            imu(
                header=header(t, measurements.frame_id),
                orientation=quaternion,
                orientation_covariance=NO_ORIENTATION,
                angular_velocity=vector(*rates),
                angular_velocity_covariance=rate_covariance,
                linear_acceleration=vector(*force),
                linear_acceleration_covariance=force_covariance,
            ),
        )


def actuator_messages(measurements: Measurements) -> Iterator[tuple[int, str, Any]]:
    """(log time, topic, message) of every actuator message."""
    names = list(measurements.channel_set.names)
    empty = np.zeros(0)
    joint_state = message_class(STAMPED_TYPE)
    array = message_class(UNSTAMPED_TYPE)
    layout = message_class("std_msgs/msg/MultiArrayLayout")(dim=[], data_offset=0)
    columns = (measurements.actuator_log_ns.tolist(), measurements.actuator_t_ns.tolist())
    for log, t, values in zip(*columns, measurements.actuators, strict=True):
        if measurements.sensors.stamped:
            message = joint_state(
                header=header(t), name=names, position=values, velocity=empty, effort=empty
            )
        else:
            message = array(layout=layout, data=values)
        yield log, ACTUATOR_TOPIC, message


def write_bag(
    measurements: Measurements,  # The flight
    path: Path | str,  # Folder of the new bag
    compress: bool = False,  # Compress with zstd
) -> None:
    """Write a measured flight as a bag, with `identifier.yaml` and `truth.yaml` beside it.

    Raises
    ------
    BagWriteError
        If the folder exists or cannot be written.
    """
    path = Path(path)
    with BagWriter(path, compress) as bag:
        bag.topic(IMU_TOPIC, IMU_TYPE, qos(500, reliable=False))
        bag.topic(ACTUATOR_TOPIC, actuator_type(measurements), qos(10))
        # At equal log times the actuators come first, as the command precedes its effect.
        streams = (actuator_messages(measurements), imu_messages(measurements))
        for log, topic, message in heapq.merge(*streams, key=lambda entry: entry[0]):
            bag.write(topic, log, message)
    meaning = "What the topics of this bag mean: parameters for the identifier and for replay."
    text = parameter_text({"/**": parameters(measurements)}, meaning)
    (path / PARAMETER_FILE).write_text(text, encoding="utf-8")
    told = yaml_text(truth(measurements), "What is true of this flight, SI, aircraft axes.")
    (path / TRUTH_FILE).write_text(told, encoding="utf-8")


def parameters(measurements: Measurements) -> dict[str, Any]:
    """Parameters of the identifier that fit this flight's topics, by dotted name."""
    channel_set = measurements.channel_set
    stamped = measurements.sensors.stamped
    names: list[Any] = list(channel_set.names if stamped else range(len(channel_set.names)))
    values: dict[str, Any] = {
        "imu.type": IMU_TYPE,
        "imu.convention": measurements.sensors.convention,
        "imu.lever_arm": list(measurements.sensors.lever_arm),
        "actuators.type": actuator_type(measurements),
        "actuators.channels": names,
        "actuators.trim": measurements.channel_trim.tolist(),
        "actuators.delay": measurements.flight.delay,
        "actuators.time_constant": measurements.flight.time_constant,
    }
    for name, row in zip(INPUTS, channel_set.mixing, strict=True):
        values[f"actuators.mixing.{name}"] = row.tolist()
    flight = measurements.flight
    if flight.airspeed is not None:
        values["airspeed.reference"] = round(float(flight.airspeed.mean()), 1)
    elif flight.structure:
        # The plant has no aerodynamic forces: its own structure has its coefficients.
        values["structure"] = "augmented"
    return values | flight.parameters


def truth(measurements: Measurements) -> dict[str, Any]:
    """Return what is true of this flight: coefficients and derivatives in SI, aircraft axes.

    From the time of a change (s) on, each coefficient it names is its old value times the factor.
    Local derivatives are those at the trimmed flight condition; the excitation is told by start and
    end, s after the first Imu sample.
    """
    flight = measurements.flight
    out: dict[str, Any] = {"flight": flight.name}
    if flight.coefficients is not None:
        structure = STRUCTURES[flight.structure]
        values = (float(flight.coefficients[index]) for index in structure.free)
        out["structure"] = structure.name
        out["coefficients"] = dict(zip(structure.names, values, strict=True))
    if flight.changes:
        out["changes"] = [asdict(change) for change in flight.changes]
    if flight.local_truth:
        out["local_derivatives"] = dict(flight.local_truth)
    return out | {"excitation": [list(pair) for pair in flight.excitation]}


def yaml_text(content: Mapping[str, Any], comment: str) -> str:
    """Return YAML of `FIGURES` figures that ROS's own parser reads, too, below a comment."""
    head = f"# SPDX-License-Identifier: Apache-2.0\n# {comment}\n"
    return head + str(yaml.dump(_rounded(content), Dumper=_Dumper, sort_keys=False, width=1000))


class _Dumper(yaml.SafeDumper):
    """Lists on one line, mappings an entry a line."""

    def represent_list(self, data: Any) -> Any:
        return self.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)


_Dumper.add_representer(list, _Dumper.represent_list)


def parameter_text(sections: Mapping[str, Mapping[str, Any]], comment: str) -> str:
    """Return a ROS parameter file: parameters by node."""
    nodes = {node: {"ros__parameters": dict(values)} for node, values in sections.items()}
    return yaml_text(nodes, comment)


def _rounded(value: Any) -> Any:
    """Numbers to `FIGURES` figures: the same text on every machine."""
    if isinstance(value, Mapping):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return float(f"{value + 0.0:.{FIGURES}g}") if isinstance(value, float) else value
