# SPDX-License-Identifier: Apache-2.0
"""Measured flights as bags, and the parameters that fit their topics."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from uav_ident_ros.bags.writing import (
    ARRAY,
    IMU,
    JOINT_STATE,
    TWIST,
    BagWriter,
    array,
    imu,
    joint_state,
    qos,
    twist_stamped,
    whole,
)
from uav_ident_ros.files.truth_file import TRUTH_FILE
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES
from uav_ident_ros.simulation.noise import Measurements

IMU_TOPIC, ACTUATOR_TOPIC, AIRSPEED_TOPIC = "/imu/data", "/actuators", "/airspeed"

PARAMETER_FILE = "identifier.yaml"

FIGURES = 9
"""Significant figures of the numbers in the files beside the bag."""


def actuator_type(measurements: Measurements) -> str:
    """Message type of the actuator topic."""
    return JOINT_STATE if measurements.sensors.stamped else ARRAY


Messages = Iterator[tuple[int, str, Any]]
"""(log time, topic, message) of every message of a topic."""


def imu_messages(m: Measurements) -> Messages:
    """Messages of the Imu."""
    noises = (m.sensors.gyro_noise, m.sensors.accelerometer_noise)
    spread, force_spread = (np.diag([noise**2] * 3).ravel() for noise in noises)
    columns = (m.imu_log_ns, m.imu_t_ns, m.rates, m.specific_force)
    for log, t, rates, force in zip(*(column.tolist() for column in columns), strict=True):
        message = imu(t, rates, force, m.frame_id, covariances=(spread, force_spread))
        yield log, IMU_TOPIC, message


def actuator_messages(m: Measurements) -> Messages:
    """Messages of the actuators."""
    stamps = zip(m.actuator_log_ns.tolist(), m.actuator_t_ns.tolist(), m.actuators, strict=True)
    for log, t, values in stamps:
        stamped = m.sensors.stamped
        message = joint_state(t, m.channel_set.names, values) if stamped else array(values)
        yield log, ACTUATOR_TOPIC, message


def airspeed_messages(m: Measurements) -> Messages:
    """Messages of the measured airspeed."""
    columns = (m.airspeed_log_ns.tolist(), m.airspeed_t_ns.tolist(), m.airspeed.tolist())
    for log, t, speed in zip(*columns, strict=True):
        yield log, AIRSPEED_TOPIC, twist_stamped(t, (speed, 0.0, 0.0))


def write_bag(
    measurements: Measurements,  # The flight
    path: Path | str,  # Folder of the new bag
    compress: bool = False,  # Compress with zstd
) -> None:
    """Write a measured flight as a bag, with `identifier.yaml` and `truth.yaml` beside it.

    Raises
    ------
    BagWriteError
        If the folder exists or cannot be written; nothing half-written stays behind.
    """
    with whole(Path(path)) as folder:
        with BagWriter(folder, compress) as bag:
            bag.topic(IMU_TOPIC, IMU, qos(500, reliable=False))
            bag.topic(ACTUATOR_TOPIC, actuator_type(measurements), qos(10))
            if len(measurements.airspeed):
                bag.topic(AIRSPEED_TOPIC, TWIST, qos(10))
            streams = (actuator_messages, imu_messages, airspeed_messages)
            bag.merge(stream(measurements) for stream in streams)
        meaning = "What the topics of this bag mean: parameters for the identifier and for replay."
        text = yaml_text({"/**": {"ros__parameters": parameters(measurements)}}, meaning)
        (folder / PARAMETER_FILE).write_text(text, encoding="utf-8")
        text = yaml_text(truth(measurements), "What is true of this flight, SI, aircraft axes.")
        (folder / TRUTH_FILE).write_text(text, encoding="utf-8")


def parameters(measurements: Measurements) -> dict[str, Any]:
    """Parameters of the identifier that fit this flight's topics, by dotted name."""
    channel_set = measurements.channel_set
    stamped = measurements.sensors.stamped
    names: list[Any] = list(channel_set.names if stamped else range(len(channel_set.names)))
    values: dict[str, Any] = {
        "imu.type": IMU,
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
        if len(measurements.airspeed):
            values["airspeed.type"] = TWIST
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


_Dumper.add_representer(
    list, lambda to, data: to.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)
)


def _rounded(value: Any) -> Any:
    """Numbers to `FIGURES` figures: the same text on every machine."""
    if isinstance(value, Mapping):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return float(f"{value + 0.0:.{FIGURES}g}") if isinstance(value, float) else value
