# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 (`.bag`), read as if ROS 2 had recorded them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SUFFIX = ".bag"


class Ros1Reader:
    """Reads a bag of ROS 1; in use like rosbags' Reader for ROS 2.

    Messages of the common interfaces are the same in both but for the header's `seq`; those of
    other types are read by the definitions in the bag.
    """

    def __init__(
        self,
        path: Path,  # The file
    ) -> None:
        self.path = path  # The file
        self._reader = Reader(path)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._reader.open()
        self.connections = self._reader.connections  # Its topics
        # start_time, end_time: Log time of the first message and the time after the last, ns
        self.start_time, self.end_time = self._reader.start_time, self._reader.end_time

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, log time and bytes (CDR) of the messages of some connections."""
        for connection in connections:
            self._learn(connection)
        for connection, log_ns, data in self._reader.messages(connections):
            yield connection, log_ns, bytes(self._store.ros1_to_cdr(data, connection.msgtype))

    def _learn(self, connection: Connection) -> None:
        """Make the bag's definition of a type known, if ROS 2 has no such type."""
        known = self._store.types
        if connection.msgtype in known or connection.msgdef.format != MessageDefinitionFormat.MSG:
            return
        found = get_types_from_msg(connection.msgdef.data, connection.msgtype)
        self._store.register({name: one for name, one in found.items() if name not in known})
