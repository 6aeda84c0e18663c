# SPDX-License-Identifier: Apache-2.0
"""Measured flights as bags: /imu/data and /actuators, and the parameters that fit them."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

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


def write_bag(measurements: Measurements, path: Path | str, compress: bool = False) -> None:
    """Write a measured flight as a bag, with `identifier.yaml` and `truth.yaml` beside it.

    Parameters
    ----------
    measurements : Measurements
        The flight.
    path : Path or str
        Folder of the new bag.
    compress : bool
        Compress with zstd.

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
    (path / PARAMETER_FILE).write_text(parameter_file(measurements), encoding="utf-8")
    (path / TRUTH_FILE).write_text(truth_file(measurements), encoding="utf-8")


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


def parameter_file(measurements: Measurements) -> str:
    """Return the ROS parameter file (YAML) of `parameters`."""
    lines = [
        "# SPDX-License-Identifier: Apache-2.0",
        "# What the topics of this bag mean: parameters for the identifier and for replay.",
        "/**:",
        "  ros__parameters:",
    ]
    lines += [f"    {name}: {_yaml(value)}" for name, value in parameters(measurements).items()]
    return "\n".join(lines) + "\n"


def truth_file(measurements: Measurements) -> str:
    """Return what is true of this flight, as YAML."""
    flight = measurements.flight
    lines = ["# SPDX-License-Identifier: Apache-2.0", f"flight: {flight.name}"]
    if flight.coefficients is not None:
        structure = STRUCTURES[flight.structure]
        lines += ["# True coefficients, SI, aircraft axes.", f"structure: {structure.name}"]
        lines += ["coefficients:"]
        lines += [
            f"  {name}: {_yaml(float(flight.coefficients[index]))}"
            for name, index in zip(structure.names, structure.free, strict=True)
        ]
    if flight.changes:
        lines += ["# From time (s) on, each coefficient named is its old value times the factor."]
        lines += ["changes:"]
        for change in flight.changes:
            factors = ", ".join(f"{k}: {_yaml(float(v))}" for k, v in change.factors.items())
            lines += [f"  - {{time: {_yaml(float(change.time))}, factors: {{{factors}}}}}"]
    if flight.local_truth:
        lines += ["# Local derivatives at the trimmed flight condition, SI, aircraft axes."]
        lines += ["local_derivatives:"]
        lines += [f"  {name}: {_yaml(float(v))}" for name, v in flight.local_truth.items()]
    lines += ["# Start and end of the excitation, s after the first Imu sample."]
    lines += [f"excitation: [{', '.join(_yaml(list(pair)) for pair in flight.excitation)}]"]
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    """YAML that ROS's own parser reads with the right type: every float has a point."""
    if isinstance(value, list):
        return f"[{', '.join(_yaml(v) for v in value)}]"
    if isinstance(value, float):
        mantissa, _, exponent = f"{value + 0.0:.{FIGURES}g}".partition("e")  # no -0.0
        mantissa = mantissa if "." in mantissa else f"{mantissa}.0"
        return f"{mantissa}e{exponent}" if exponent else mantissa
    return str(value)
