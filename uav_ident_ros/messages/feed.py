# SPDX-License-Identifier: Apache-2.0
"""Feed of one input stream: from message bytes to the identifier, with counts of the drops."""

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.messages.streams import Stream
from uav_ident_ros.messages.types import NS_PER_S, ChannelError, RatesReading

IMU_TYPE = "sensor_msgs/msg/Imu"

_CDR_HEADER = 4
"""Encapsulation header before the CDR body, bytes: alignment counts from its end."""

# First stamp and length of the frame_id. Then, from the first double on: orientation with its
# covariance (skipped), rates, first entry of their covariance, its rest (skipped), the force alike.
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
        None if the bytes have another form, for a full decoder.
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
"""Largest size of an input message, bytes: an Imu has 350, a hundred named channels 4000. Names in
a larger one would fill the log and /diagnostics, and take a second to read."""

Taken = tuple[int, Any] | None
"""Stamp, ns, and values that the identifier accepted; None if it accepted none."""


class Feed:
    """Feed of one stream's messages to an identifier, with counts of the refused ones.

    A message without a stamp gets its time of arrival. If the Imu's stamps have another time base,
    such as the autopilot's start, one of an `any_clock` stream is placed just after the newest Imu
    sample. If it arrived before any, it is placed just after the first.
    """

    def __init__(
        self,
        stream: Stream,  # Type and destination of the messages
        identifier: OnlineIdentifier,  # Receives the values
        decode: Callable[[bytes], Any],  # Bytes to a message; it may raise `ChannelError`
        # Receives the reason, as counted, and the problem of each unused message
        warn: Callable[[str, str], object] = lambda reason, problem: None,
        # Receives once the time of arrival minus the Imu's stamp, s, if they differ
        on_offset: Callable[[float], object] = lambda seconds: None,
    ) -> None:
        self.stream = stream
        self.type_name = stream.type_of(identifier.settings)
        self.reader: Any = stream.reader(identifier.settings)
        self.received = 0  # Messages, good or bad
        self.details: dict[str, str] = {}  # Problem of the last message for each reason
        self._identifier, self._decode, self._warn = identifier, decode, warn
        self._refused: Counter[str] = Counter()
        self._jump_ns = round(identifier.settings.time_jump * NS_PER_S)
        self._on_offset: Callable[[float], object] | None = on_offset
        self._unplaced: tuple[int, Any] | None = None  # Arrival, ns, and values
        self._after_ns = self._placed = 0  # Imu sample, ns, and number of messages placed after it

    def take(self, data: bytes, arrival_ns: int) -> Taken:
        """Add a message; `arrival_ns` is by the clock of the node or recorder."""
        self.received += 1
        try:
            if len(data) > LARGEST_MESSAGE:
                problem = f"it takes {len(data)} bytes: is it {self.type_name} at all?"
                raise ChannelError(problem, "too large")
            # Decoding an Imu here costs a fraction of making a message object.
            imu = decode_imu_cdr(data) if self.type_name == IMU_TYPE else None
            stamp_ns, values = self.reader(imu or self._decode(data))
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
        """Add the message that waits for the first Imu sample, if due; call it before each tick."""
        newest_ns = self._identifier.intake.newest_ns
        if self._unplaced is None or newest_ns is None:
            return None
        (arrival_ns, values), self._unplaced = self._unplaced, None
        off_ns = arrival_ns - newest_ns
        if abs(off_ns) <= self._jump_ns:
            return self._add(arrival_ns, values)
        if self._on_offset is not None:
            self._on_offset(off_ns / NS_PER_S)
            self._on_offset = None
        # Messages after the same Imu sample get distinct stamps: the last one counts.
        self._placed = self._placed + 1 if newest_ns == self._after_ns else 1
        self._after_ns = newest_ns
        return self._add(newest_ns + self._placed, values)

    def drops(self) -> Counter[str]:
        """Return the numbers of messages refused here or dropped by the identifier, by reason."""
        dropped = self._identifier.intake.drops[self.stream.name]
        return self._refused + Counter({drop.value: n for drop, n in dropped.items()})
