# SPDX-License-Identifier: Apache-2.0
"""One input on its way from bytes to the identifier, live and offline, and what became of it."""

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.messages.streams import Stream
from uav_ident_ros.messages.types import NS_PER_S, ChannelError, RatesReading

IMU_TYPE = "sensor_msgs/msg/Imu"

_CDR_HEADER = 4
"""Encapsulation header before the CDR body, bytes: what is in the body is aligned from there on."""

# Stamp and length of the frame_id; then, from the first double on: orientation with its
# covariance, rates, first entry of their covariance, the rest of it, and the force likewise.
_IMU_FORMATS = {
    b"\x00\x01": (struct.Struct("<iII"), struct.Struct("<104x4d64x4d64x")),
    b"\x00\x00": (struct.Struct(">iII"), struct.Struct(">104x4d64x4d64x")),
}


def decode_imu_cdr(
    # Serialized sensor_msgs/msg/Imu with its encapsulation header (XCDR1, either byte order)
    data: bytes,
) -> RatesReading | None:
    """Read an Imu message from its CDR bytes, several times faster than a decoder in Python.

    Returns
    -------
    RatesReading or None
        None if the bytes are not of that form: leave them to a full decoder.
    """
    formats = _IMU_FORMATS.get(bytes(data[:2]))
    if formats is None:
        return None
    prefix, vectors = formats
    try:
        seconds, nanoseconds, length = prefix.unpack_from(data, _CDR_HEADER)
        start = _CDR_HEADER + prefix.size
        body = _CDR_HEADER + ((prefix.size + length + 7) & -8)  # doubles are aligned to 8 bytes
        p, q, r, rate_covariance, ax, ay, az, force_covariance = vectors.unpack_from(data, body)
        frame_id = str(data[start : start + length - 1], "utf-8")
    except (struct.error, UnicodeDecodeError):
        return None
    return RatesReading(
        seconds * NS_PER_S + nanoseconds,
        None if rate_covariance == -1.0 else (p, q, r),
        None if force_covariance == -1.0 else (ax, ay, az),
        frame_id,
    )


# --- one input ------------------------------------------------------------------------------------


LARGEST_MESSAGE = 65_536
"""Bytes of a message beyond which it is none of these: an Imu takes 350, a hundred named channels
4000. Its names or its frame would fill the log and /diagnostics, and take a second to read."""

Taken = tuple[int, Any] | None
"""Stamp, ns, and values that the identifier took; None if it did not."""


class Feed:
    """Gives an identifier the messages of one stream, and counts those that it does not get.

    What carries no time counts from when it arrives. Where the Imu's stamps are far from that, as
    those of an autopilot that counts from its start, a stream of any clock counts from just after
    the Imu's newest sample; what came before there was any, from just after the first.
    """

    def __init__(
        self,
        stream: Stream,  # What the messages are
        identifier: OnlineIdentifier,  # Takes what is in them
        decode: Callable[[bytes], Any],  # Bytes to a message; it may raise `ChannelError`
        # Told the reason, as it is counted, and the words, where a message is not used
        warn: Callable[[str, str], object] = lambda reason, words: None,
        # Told once, in s, how far messages that carry no time arrive from the Imu's stamps
        on_offset: Callable[[float], object] = lambda seconds: None,
    ) -> None:
        self.stream = stream
        self.type_name = stream.type_of(identifier.settings)
        self.reader: Any = stream.reader(identifier.settings)
        self.received = 0  # Messages, good or bad
        self.details: dict[str, str] = {}  # What was wrong with the last one of each reason
        self._identifier, self._decode, self._warn = identifier, decode, warn
        self._refused: Counter[str] = Counter()
        self._jump_ns = round(identifier.settings.time_jump * 1e9)
        self._on_offset: Callable[[float], object] | None = on_offset
        self._unplaced: tuple[int, Any] | None = None  # Arrival, ns, and values
        self._after_ns = self._placed = 0  # Imu sample, and how many were placed after it

    def take(self, data: bytes, arrival_ns: int) -> Taken:
        """Give the identifier a message that arrived then, by the node's or recorder's clock."""
        self.received += 1
        try:
            if len(data) > LARGEST_MESSAGE:
                words = f"it takes {len(data)} bytes: is it {self.type_name} at all?"
                raise ChannelError(words, "too large")
            # Decoding an Imu here costs a fraction of making a message object of it.
            imu = decode_imu_cdr(data) if self.type_name == IMU_TYPE else None
            stamp_ns, values = self.reader.checked(imu) if imu else self.reader(self._decode(data))
        except ChannelError as error:
            self._refused[error.reason] += 1
            self.details[error.reason] = str(error)
            self._warn(error.reason, str(error))
            return None
        if stamp_ns is None and self.stream.any_clock:
            self._unplaced = arrival_ns, values
            return self.settle()
        return self._add(arrival_ns if stamp_ns is None else stamp_ns, values)

    def _add(self, stamp_ns: int, values: Any) -> Taken:
        drop = self.stream.add(self._identifier, stamp_ns, values)
        if drop is None:
            return stamp_ns, values
        self._warn(drop.value, drop.value)
        return None

    def settle(self) -> Taken:
        """Place what came before the Imu did; to be called before a tick is computed."""
        newest_ns = self._identifier.intake.newest_ns
        if self._unplaced is None or newest_ns is None:
            return None
        (arrival_ns, values), self._unplaced = self._unplaced, None
        off_ns = arrival_ns - newest_ns
        if abs(off_ns) <= self._jump_ns:
            return self._add(arrival_ns, values)
        if self._on_offset is not None:
            self._on_offset(off_ns * 1e-9)
            self._on_offset = None
        # Of several after one sample each has a stamp of its own: the last one counts.
        self._placed = self._placed + 1 if newest_ns == self._after_ns else 1
        self._after_ns = newest_ns
        return self._add(newest_ns + self._placed, values)

    def drops(self) -> Counter[str]:
        """Return what was refused here or dropped by the identifier, by reason."""
        dropped = self._identifier.intake.drops[self.stream.name]
        return self._refused + Counter({drop.value: n for drop, n in dropped.items()})
