# SPDX-License-Identifier: Apache-2.0
"""Serialized messages to message objects, with the bytes that ROS 2's serializers leave over.

`rclpy.serialization.serialize_message`, and so what `rosbag2_py` writes from it, hands over all the
room that it has reserved. Its type support aligns for the elements of an empty sequence, too: a
JointState without velocities and efforts ends with four to twelve bytes that nobody has written.
rosbags refuses any bytes but three beyond a message.
"""

from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP
from rosbags.typesys.store import Typestore

_CDR_HEADER = 4
"""Encapsulation header before the CDR body, bytes."""

_ROUNDING = 3
"""Bytes by which the length of a whole message is rounded up to four."""


def decode_cdr(
    store: Typestore,  # Knows the type
    data: bytes,  # Serialized message with its encapsulation header (XCDR1, either byte order)
    msgtype: str,  # Its type
) -> Any:
    """Return the message; raises `ValueError` and what rosbags does if the bytes are no such one.

    Bytes beyond it are left out if a serializer reserves as many for this message.
    """
    if bytes(data[:2]) not in (b"\x00\x00", b"\x00\x01"):
        raise ValueError("no CDR encapsulation")
    definition, body = store.get_msgdef(msgtype), memoryview(data)[_CDR_HEADER:]
    decode = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
    message, end = decode(body, 0, definition.cls, store)
    if len(body) > end + _ROUNDING:
        reserved = _reserved(store, (Nodetype.NAME, msgtype), message, 0)
        if len(body) > reserved + _ROUNDING:
            raise ValueError(f"{len(body) - end} bytes follow the message")
    return message


def _reserved(
    store: Typestore,
    field: Any,  # What the value is: the kind of node, and its details
    value: Any,
    start: int,  # Where it begins in the body, bytes
) -> int:
    """Return where the room ends that serializers of ROS 2 reserve for a value, bytes."""
    node, details = field
    if node == Nodetype.NAME:
        for name, inner in store.get_msgdef(details).fields:
            start = _reserved(store, inner, getattr(value, name), start)
        return start
    if node == Nodetype.BASE:
        if details[0] == "string":
            return _aligned(start, 4) + 4 + len(str(value).encode()) + 1
        size: int = SIZEMAP[details[0]]
        return _aligned(start, size) + size
    if node == Nodetype.SEQUENCE:
        start = _aligned(start, 4) + 4
    inner = details[0]
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":  # aligned even if there is none
        size = SIZEMAP[inner[1][0]]
        count: int = len(value)
        return _aligned(start, size) + size * count
    for item in value:
        start = _reserved(store, inner, item, start)
    return start


def _aligned(start: int, size: int) -> int:
    return (start + size - 1) & -size
