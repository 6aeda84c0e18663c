# SPDX-License-Identifier: Apache-2.0
"""Estimates as a bag: the node's own output topics, log time = tick time."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.bags.writing import (
    BagWriteError,
    BagWriter,
    header,
    jazzy_types,
    message_class,
    qos,
)
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import FloatArray, Structure
from uav_ident_ros.messages.published import (
    coefficients_layout,
    dense_coefficients,
    entry_names,
    named_entries,
)
from uav_ident_ros.messages.types import NS_PER_S

NAMED_TYPE = "sensor_msgs/msg/JointState"
ARRAY_TYPE = "std_msgs/msg/Float64MultiArray"
VECTOR_TYPE = "geometry_msgs/msg/Vector3Stamped"

_CDR_STAMP = 4
"""Where a message's header stamp lies in its CDR bytes."""


class _Template:
    """A serialized message with places for its stamp and its numbers.

    Only these differ from tick to tick: filling them in is many times faster than serializing.
    """

    def __init__(
        self,
        message: Any,  # The message; the numbers of its slots occur nowhere else in it
        msgtype: str,
        # (k,) The numbers in the message that stand for those to be filled in
        slots: list[FloatArray],
        *,
        stamped: bool = True,  # Whether it begins with a std_msgs/Header
    ) -> None:
        self._bytes = bytes(jazzy_types().serialize_cdr(message, msgtype))
        sizes = [8 * len(slot) for slot in slots]
        starts = [self._bytes.index(slot.tobytes()) for slot in slots]
        self._places = [slice(a, a + n) for a, n in zip(starts, sizes, strict=True)]
        self._stamped = stamped

    def filled(self, t_ns: int, *numbers: FloatArray) -> bytes:
        """Return the bytes with stamp and numbers."""
        data = bytearray(self._bytes)
        if self._stamped:
            seconds, nanoseconds = divmod(t_ns, NS_PER_S)
            data[_CDR_STAMP : _CDR_STAMP + 4] = seconds.to_bytes(4, "little", signed=True)
            data[_CDR_STAMP + 4 : _CDR_STAMP + 8] = nanoseconds.to_bytes(4, "little")
        for place, values in zip(self._places, numbers, strict=True):
            data[place] = np.ascontiguousarray(values, dtype=np.float64).tobytes()
        return bytes(data)


class EstimatesBag:
    """Writes estimates on the node's topics into an open bag."""

    def __init__(
        self,
        bag: BagWriter,
        structure: Structure,
        node: str,  # Full name of the node whose topics these are
        frame_id: str,  # Frame of the predicted rates: that of the Imu
    ) -> None:
        self._bag = bag
        self._structure = structure
        self._topics = [
            f"{node}/{name}"
            for name in (
                "coefficients_named", "coefficients", "predicted_rates", "prediction_error"
            )
        ]  # fmt: skip
        latched, reliable = qos(1, transient_local=True), qos(10)
        types = (NAMED_TYPE, ARRAY_TYPE, VECTOR_TYPE, VECTOR_TYPE)
        profiles = (latched, latched, reliable, reliable)
        for topic, msgtype, profile in zip(self._topics, types, profiles, strict=True):
            bag.topic(topic, msgtype, profile)
        self._named = _named_template(structure)
        self._array = _array_template(structure)
        self._vector = _vector_template(frame_id)

    def write(self, estimate: Estimate) -> None:
        """Write one estimate on every topic."""
        t_ns = estimate.t_ns
        entries = named_entries(estimate, self._structure)
        messages = (
            self._named.filled(t_ns, entries.positions, entries.efforts),
            self._array.filled(t_ns, dense_coefficients(estimate, self._structure)),
            self._vector.filled(t_ns, estimate.predicted_rates),
            self._vector.filled(t_ns, estimate.prediction_error),
        )
        for topic, data in zip(self._topics, messages, strict=True):
            self._bag.write(topic, t_ns, data)


def _marks(count: int, first: int) -> FloatArray:
    """Numbers that are found again in a message's bytes."""
    return np.arange(first, first + count) + 0.123456789


def _named_template(structure: Structure) -> _Template:
    names = list(entry_names(structure))
    slots = [_marks(len(names), 1), _marks(len(names), 1001)]
    message = message_class(NAMED_TYPE)(
        header=header(0), name=names, position=slots[0], velocity=np.zeros(0), effort=slots[1]
    )
    return _Template(message, NAMED_TYPE, slots)


def _array_template(structure: Structure) -> _Template:
    dimension = message_class("std_msgs/msg/MultiArrayDimension")
    rows, columns = coefficients_layout(structure)
    layout = message_class("std_msgs/msg/MultiArrayLayout")(
        dim=[dimension(*rows), dimension(*columns)], data_offset=0
    )
    slot = _marks(rows.size * columns.size, 1)
    message = message_class(ARRAY_TYPE)(layout=layout, data=slot)
    return _Template(message, ARRAY_TYPE, [slot], stamped=False)


def _vector_template(frame_id: str) -> _Template:
    slot = _marks(3, 1)
    vector = message_class("geometry_msgs/msg/Vector3")(*slot.tolist())
    message = message_class(VECTOR_TYPE)(header=header(0, frame_id), vector=vector)
    return _Template(message, VECTOR_TYPE, [slot])


def write_estimates(
    path: Path,  # Folder of the bag
    estimates: Iterable[Estimate],  # In the order of their ticks
    structure: Structure,  # structure, node, frame_id: See `EstimatesBag`
    node: str,
    frame_id: str,
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
    try:
        working.mkdir()
        with BagWriter(working / path.name) as bag:
            writer = EstimatesBag(bag, structure, node, frame_id)
            for estimate in estimates:
                writer.write(estimate)
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
