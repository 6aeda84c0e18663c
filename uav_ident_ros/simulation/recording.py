# SPDX-License-Identifier: Apache-2.0
"""Recording of measured flights as bags, and the parameters for their topics."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
from uav_ident_ros.files.parameter_file import PARAMETER_FILE
from uav_ident_ros.files.truth_file import TRUTH_FILE
from uav_ident_ros.identification.samples import ACTUATORS, AIRSPEED, RATES_STREAM
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES
from uav_ident_ros.messages.types import FRAME_IDS
from uav_ident_ros.simulation.noise import Measurements, SentSample

TOPICS = {RATES_STREAM: "/imu/data", ACTUATORS: "/actuators", AIRSPEED: "/airspeed"}

FIGURES = 9
"""Significant figures of the numbers in the files beside the bag."""


def actuator_type(measurements: Measurements) -> str:
    """Return the message type of the actuator topic."""
    return JOINT_STATE if measurements.sensors.stamped else ARRAY


def as_message(measured: SentSample, m: Measurements) -> Any:
    """Return the ROS message of a sample."""
    t_ns, values = measured.t_ns, measured.values
    if measured.stream == RATES_STREAM:
        frame, covariances = FRAME_IDS[m.sensors.convention], m.sensors.covariances
        return imu(t_ns, values[:3], values[3:], frame, covariances=covariances)
    if measured.stream == AIRSPEED:
        return twist_stamped(t_ns, (*values, 0.0, 0.0))
    return (
        joint_state(t_ns, m.flight.channel_set.names, values)
        if m.sensors.stamped
        else array(values)
    )


def write_bag(
    measurements: Measurements,  # The flight
    path: Path | str,  # Folder of the new bag
    compress: bool = False,  # Compress with zstd
) -> None:
    """Write a measured flight as a bag, with `identifier.yaml` and `truth.yaml` beside it.

    A failure leaves no partial bag.
    """
    with whole(Path(path)) as folder:
        with BagWriter(folder, compress) as bag:
            bag.topic(TOPICS[RATES_STREAM], IMU, qos(500, reliable=False))
            bag.topic(TOPICS[ACTUATORS], actuator_type(measurements), qos(10))
            if len(measurements.airspeed):
                bag.topic(TOPICS[AIRSPEED], TWIST, qos(10))
            for sample in measurements.messages():
                message = as_message(sample, measurements)
                bag.write(TOPICS[sample.stream], sample.arrival_ns, message)
        meaning = "What the topics of this bag mean: parameters for the identifier and for replay."
        text = yaml_text({"/**": {"ros__parameters": parameters(measurements)}}, meaning)
        (folder / PARAMETER_FILE).write_text(text, encoding="utf-8")
        text = yaml_text(truth(measurements), "What is true of this flight, SI, aircraft axes.")
        (folder / TRUTH_FILE).write_text(text, encoding="utf-8")


def parameters(measurements: Measurements) -> dict[str, Any]:
    """Return the identifier's parameters for the flight's topics, by dotted name."""
    flight, stamped = measurements.flight, measurements.sensors.stamped
    channel_set = flight.channel_set
    names: list[Any] = list(channel_set.names if stamped else range(len(channel_set.names)))
    values: dict[str, Any] = {
        "imu.type": IMU,
        "imu.convention": measurements.sensors.convention,
        "imu.lever_arm": list(measurements.sensors.lever_arm),
        "actuators.type": actuator_type(measurements),
        "actuators.channels": names,
        "actuators.trim": flight.channel_trim.tolist(),
        "actuators.delay": flight.delay,
        "actuators.time_constant": flight.time_constant,
    }
    for name, row in zip(INPUTS, channel_set.mixing, strict=True):
        values[f"actuators.mixing.{name}"] = row.tolist()
    if flight.airspeed is not None:
        values["airspeed.reference"] = round(float(flight.airspeed.mean()), 1)
        if len(measurements.airspeed):
            values["airspeed.type"] = TWIST
    elif flight.structure:
        # The plant has no aerodynamic forces: flight_dynamics cannot represent it.
        values["structure"] = "augmented"
    return values | flight.parameters


def truth(measurements: Measurements) -> dict[str, Any]:
    """Return the truth of the flight: coefficients and derivatives in SI, aircraft axes.

    The coefficients are those at the start, local derivatives hold at the trimmed flight condition.
    """
    flight = measurements.flight
    out: dict[str, Any] = {"flight": flight.name}
    if flight.coefficients is not None:
        structure = STRUCTURES[flight.structure]
        out["structure"] = structure.name
        out["coefficients"] = {
            name: float(flight.coefficients[place]) for name, place in structure.places.items()
        }
    if flight.local_truth:
        out["local_derivatives"] = dict(flight.local_truth)
    return out


def yaml_text(content: Mapping[str, Any], comment: str) -> str:
    """Return YAML below a comment, with `FIGURES` figures, readable by ROS's own parser."""
    head = f"# SPDX-License-Identifier: Apache-2.0\n# {comment}\n"
    return head + str(yaml.dump(_rounded(content), Dumper=_Dumper, sort_keys=False, width=1000))


class _Dumper(yaml.SafeDumper):
    """Dumper of lists on one line, and mappings with one entry in a line."""


_Dumper.add_representer(
    list, lambda to, data: to.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)
)


def _rounded(value: Any) -> Any:
    """Return numbers rounded to `FIGURES` figures, for the same text on every machine."""
    if isinstance(value, Mapping):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return float(f"{value + 0.0:.{FIGURES}g}") if isinstance(value, float) else value
