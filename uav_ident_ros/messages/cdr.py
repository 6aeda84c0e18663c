# SPDX-License-Identifier: Apache-2.0
"""Serialized messages, read and written in place: for the few that come and go at high rates.

To make a message object of the bytes, or bytes of a message object, costs rclpy several times
what it takes to pick or to place the numbers. Everything is checked against the message's own
lengths; what is of another form is left to the full decoder.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import NS_PER_S, ActuatorReading

HEADER_SIZE = 4
"""Encapsulation header before the CDR body, bytes; alignment counts from its end."""

STAMP_END = HEADER_SIZE + 8
"""Where a stamp ends in a message that begins with one."""

BYTE_ORDERS = {b"\x00\x01": "<", b"\x00\x00": ">"}
"""Byte order, for struct, by the encapsulation of plain CDR."""


NOT_UNDERSTOOD = -1
"""Size of no message: an empty one has 0 bytes."""


class _OtherFormError(Exception):
    """The bytes are not such a message, or not in plain CDR."""


class _Walk:
    """Walks through the members of a serialized message."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.order = BYTE_ORDERS.get(bytes(data[:2]), "")
        if not self.order:
            raise _OtherFormError
        self.at = HEADER_SIZE
        self._uint = struct.Struct(f"{self.order}I")

    def skip(self, size: int) -> int:
        """Step over `size` bytes, which must be there; return where they begin."""
        begin, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise _OtherFormError
        return begin

    def align(self, size: int) -> None:
        self.at += -(self.at - HEADER_SIZE) % size

    def uint(self) -> int:
        self.align(4)
        (value,) = self._uint.unpack_from(self.data, self.skip(4))
        return int(value)

    def string(self) -> str:
        size = self.uint()
        begin = self.skip(size)
        text = bytes(self.data[begin : begin + size])
        if not text.endswith(b"\x00"):
            raise _OtherFormError
        try:
            return text[:-1].decode()
        except UnicodeDecodeError:
            raise _OtherFormError from None

    def sequence(self, item_size: int) -> tuple[int, int]:
        """Step over numbers; return where they begin, and how many there are."""
        count = self.uint()
        if count:
            self.align(item_size)
        return self.skip(count * item_size), count


Found = tuple[int, int, list[str] | None]
"""Where the numbers begin, how many there are, and their names."""


def _find_positions(walk: _Walk) -> Found:
    """sensor_msgs/msg/JointState: stamp, frame, names, positions, velocities, efforts."""
    walk.skip(STAMP_END - HEADER_SIZE)
    walk.string()
    names = [walk.string() for _ in range(walk.uint())]
    begin, count = walk.sequence(8)
    walk.sequence(8)
    walk.sequence(8)
    return begin, count, names


def _find_data(walk: _Walk, item_size: int) -> Found:
    """std_msgs/msg/Float64MultiArray, Float32MultiArray: layout, then the data."""
    for _ in range(walk.uint()):
        walk.string()
        walk.uint()
        walk.uint()
    walk.uint()
    begin, count = walk.sequence(item_size)
    return begin, count, None


def _find_doubles(walk: _Walk) -> Found:
    return _find_data(walk, 8)


def _find_floats(walk: _Walk) -> Found:
    return _find_data(walk, 4)


_FORMS: dict[tuple[str, str], tuple[Callable[[_Walk], Found], str, bool]] = {
    ("sensor_msgs/msg/JointState", "position"): (_find_positions, "d", True),
    ("std_msgs/msg/Float64MultiArray", "data"): (_find_doubles, "d", False),
    ("std_msgs/msg/Float32MultiArray", "data"): (_find_floats, "f", False),
}
"""How to find the numbers by type and field, their format, and whether a stamp comes first."""


class ChannelsDecoder:
    """Reads actuator channels from bytes.

    What stands before the numbers (lengths, names, labels) is the same in every message of a
    stream. It is understood once, and then only compared.

    Parameters
    ----------
    type_name, field : str
        Message type and its array field.
    """

    def __init__(self, type_name: str, field: str) -> None:
        self._find, self._format, self._stamped = _FORMS[type_name, field]
        self._before = slice(STAMP_END if self._stamped else HEADER_SIZE, 0)
        self._size = NOT_UNDERSTOOD
        self._encapsulation = self._known = b""
        self._names: list[str] | None = None
        self._stamp = self._numbers = struct.Struct("")

    @staticmethod
    def knows(type_name: str, field: str) -> bool:
        """Whether this decoder can read the field of such messages."""
        return (type_name, field) in _FORMS

    def __call__(self, data: bytes) -> ActuatorReading | None:
        """Return stamp, channels and their names; None if the bytes are of another form."""
        as_before = (
            len(data) == self._size
            and data[:HEADER_SIZE] == self._encapsulation
            and data[self._before] == self._known
        )
        if not (as_before or self._understand(data)):
            return None
        stamp_ns = None
        if self._stamped:
            seconds, nanoseconds = self._stamp.unpack_from(data, HEADER_SIZE)
            stamp_ns = seconds * NS_PER_S + nanoseconds
        numbers = self._numbers.unpack_from(data, self._before.stop)
        return ActuatorReading(stamp_ns, numbers, self._names)

    def _understand(self, data: bytes) -> bool:
        """Find the numbers; return whether that was possible."""
        try:
            walk = _Walk(data)
            begin, count, self._names = self._find(walk)
        except _OtherFormError:
            self._size = NOT_UNDERSTOOD
            return False
        self._size = len(data)
        self._encapsulation = data[:HEADER_SIZE]
        self._before = slice(self._before.start, begin)
        self._known = data[self._before]
        self._stamp = struct.Struct(f"{walk.order}iI")
        self._numbers = struct.Struct(f"{walk.order}{count}{self._format}")
        return True


class Template:
    """A message of fixed form, serialized once; after that only its numbers are placed.

    Parameters
    ----------
    message : Any
        The message; its arrays hold the numbers in `marks`.
    marks : sequence of arrays
        Numbers that are found nowhere else in the message: where they stand, others go.
    """

    def __init__(self, message: Any, marks: Sequence[FloatArray]) -> None:
        from rclpy.serialization import serialize_message

        self._data = bytearray(serialize_message(message))
        self._places: list[slice] = []
        for mark in marks:
            number = mark.tobytes()
            if self._data.count(number) != 1:
                raise ValueError(f"{mark} stands {self._data.count(number)} times in {message}")
            begin = self._data.index(number)
            self._places.append(slice(begin, begin + len(number)))
        self._stamp = struct.Struct("=iI")

    def stamp(self, t_ns: int) -> None:
        """Place the stamp of a message that begins with a header, ns."""
        self._stamp.pack_into(self._data, HEADER_SIZE, t_ns // NS_PER_S, t_ns % NS_PER_S)

    def filled(self, *values: FloatArray) -> bytes:
        """Return the message with `values` in the places of the marks, in their order."""
        for place, numbers in zip(self._places, values, strict=True):
            placed = np.asarray(numbers, dtype=np.float64).tobytes()
            if len(placed) != place.stop - place.start:
                raise ValueError(f"{len(numbers)} numbers do not fit in the message")
            self._data[place] = placed
        return bytes(self._data)
