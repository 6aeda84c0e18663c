# SPDX-License-Identifier: Apache-2.0
"""Estimates as a bag: the node's own output topics, log time = tick time."""

from collections.abc import Iterable
from pathlib import Path

from uav_ident_ros.bags.messages import (
    ARRAY,
    JOINT_STATE,
    VECTOR,
    array,
    joint_state,
    vector_stamped,
)
from uav_ident_ros.bags.writing import BagWriteError, BagWriter, qos, whole
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import Structure
from uav_ident_ros.messages.published import (
    coefficients_layout,
    dense_coefficients,
    named_entries,
)


def write_estimates(
    path: Path,  # Folder of the bag
    estimates: Iterable[Estimate],  # In the order of their ticks
    structure: Structure,  # Their structure
    node: str,  # Full name of the node whose topics these are
    frame_id: str,  # Frame of the predicted rates: that of the Imu
) -> None:
    """Write a bag of estimates; one that was written here before is replaced.

    Raises
    ------
    BagWriteError
        If `path` is something other than a bag, or cannot be written.
    """
    if path.exists() and not _is_bag(path):
        raise BagWriteError(f"'{path}' exists and is no bag: it is left alone")
    latched, reliable = qos(1, transient_local=True), qos(10)
    topics = {
        "coefficients_named": (JOINT_STATE, latched),
        "coefficients": (ARRAY, latched),
        "predicted_rates": (VECTOR, reliable),
        "prediction_error": (VECTOR, reliable),
    }
    layout = coefficients_layout(structure)
    with whole(path, replace=True) as working, BagWriter(working) as bag:
        for topic, (msgtype, profile) in topics.items():
            bag.topic(f"{node}/{topic}", msgtype, profile)
        for e in estimates:
            rates, errors = e.predicted_rates.tolist(), e.prediction_error.tolist()
            messages = (
                joint_state(e.t_ns, *named_entries(e, structure)),
                array(dense_coefficients(e, structure), layout),
                vector_stamped(e.t_ns, rates, frame_id),
                vector_stamped(e.t_ns, errors, frame_id),
            )
            for topic, message in zip(topics, messages, strict=True):
                bag.write(f"{node}/{topic}", e.t_ns, message)


def _is_bag(path: Path) -> bool:
    """Whether a folder holds a bag and nothing else."""
    if not path.is_dir():
        return False
    files = [file for file in path.iterdir() if file.name != "metadata.yaml"]
    return all(file.suffix == ".mcap" and file.is_file() for file in files)
