# SPDX-License-Identifier: Apache-2.0
"""Estimates as a bag: the node's own output topics, log time = tick time."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Qos

from uav_ident_ros.bags.messages import (
    ARRAY,
    JOINT_STATE,
    VECTOR,
    array,
    joint_state,
    vector_stamped,
)
from uav_ident_ros.bags.writing import BagWriteError, BagWriter, qos
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages.published import (
    coefficients_layout,
    dense_coefficients,
    named_entries,
)


class _Topic(NamedTuple):
    name: str
    msgtype: str
    profile: Qos
    message: Callable[[Estimate], Any]


def _topics(structure: Structure, frame_id: str) -> tuple[_Topic, ...]:
    """Return the outputs of the node, and how an estimate becomes a message of each."""
    layout = coefficients_layout(structure)

    def named(estimate: Estimate) -> Any:
        return joint_state(estimate.t_ns, *named_entries(estimate, structure))

    def dense(estimate: Estimate) -> Any:
        return array(dense_coefficients(estimate, structure), layout)

    def rates(estimate: Estimate, values: FloatArray) -> Any:
        return vector_stamped(estimate.t_ns, values.tolist(), frame_id)

    latched, reliable = qos(1, transient_local=True), qos(10)
    return (
        _Topic("coefficients_named", JOINT_STATE, latched, named),
        _Topic("coefficients", ARRAY, latched, dense),
        _Topic("predicted_rates", VECTOR, reliable, lambda e: rates(e, e.predicted_rates)),
        _Topic("prediction_error", VECTOR, reliable, lambda e: rates(e, e.prediction_error)),
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
    working = path.parent / f".{path.name}.part"
    shutil.rmtree(working, ignore_errors=True)
    topics = _topics(structure, frame_id)
    try:
        working.mkdir()
        with BagWriter(working / path.name) as bag:
            for topic in topics:
                bag.topic(f"{node}/{topic.name}", topic.msgtype, topic.profile)
            for estimate in estimates:
                for topic in topics:
                    bag.write(f"{node}/{topic.name}", estimate.t_ns, topic.message(estimate))
        if path.exists():
            shutil.rmtree(path)
        (working / path.name).rename(path)
    except OSError as error:
        raise BagWriteError(f"cannot write bag '{path}': {error.strerror}") from None
    finally:
        shutil.rmtree(working, ignore_errors=True)


def _is_bag(path: Path) -> bool:
    """Whether a folder holds a bag and nothing else."""
    if not path.is_dir():
        return False
    files = [file for file in path.iterdir() if file.name != "metadata.yaml"]
    return all(file.suffix == ".mcap" and file.is_file() for file in files)
