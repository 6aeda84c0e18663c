# SPDX-License-Identifier: Apache-2.0
"""One input on its way from bytes to the identifier, live and offline, and what became of it."""

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import Drop
from uav_ident_ros.messages.streams import Stream
from uav_ident_ros.messages.types import NS_PER_S, ChannelError, RatesReading, Reading

IMU_TYPE = "sensor_msgs/msg/Imu"

_CDR_HEADER = 4
"""Encapsulation header before the CDR body, bytes."""

_IMU_BODY_DOUBLES = 37
"""Doubles of an Imu after its header: 4 + 9, 3 + 9, 3 + 9."""

# Stamp and length of the frame_id; then, from the first double on: orientation with its
# covariance, rates, first entry of their covariance, the rest of it, and the force likewise.
_IMU_FORMATS = {
    b"\x00\x01": (struct.Struct("<iII"), struct.Struct("<104x4d64x4d")),
    b"\x00\x00": (struct.Struct(">iII"), struct.Struct(">104x4d64x4d")),
}
_IMU_PREFIX_SIZE = 12
_CDR_ALIGNMENT = 8


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
    if formats is None or len(data) < _CDR_HEADER + _IMU_PREFIX_SIZE:
        return None
    prefix, vectors = formats
    seconds, nanoseconds, length = prefix.unpack_from(data, _CDR_HEADER)
    start = _CDR_HEADER + _IMU_PREFIX_SIZE
    # the doubles are aligned as from the CDR body on
    body = ((_IMU_PREFIX_SIZE + length + _CDR_ALIGNMENT - 1) & -_CDR_ALIGNMENT) + _CDR_HEADER
    if length < 1 or len(data) < body + 8 * _IMU_BODY_DOUBLES:
        return None
    p, q, r, rate_covariance, ax, ay, az, force_covariance = vectors.unpack_from(data, body)
    try:
        frame_id = str(data[start : start + length - 1], "utf-8")
    except UnicodeDecodeError:
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

Values = TypeVar("Values")


class Arrivals(Generic[Values]):
    """Puts what carries no time on the Imu's clock, where a few milliseconds do not matter.

    It counts from when it arrives. Where the Imu's stamps are far from that, as those of an
    autopilot that counts from its start, it counts from just after the Imu's newest sample; what
    came before there was any, from just after the first to be looked at.
    """

    def __init__(
        self,
        identifier: OnlineIdentifier,  # Knows the Imu's stamps
        # Stamp, ns, and values to the identifier; returns why it dropped them, or None
        add: Callable[[int, Values], Drop | None],
        # Told once, in s, how far the arrival of a message is from the Imu's stamps
        on_offset: Callable[[float], None] | None = None,
    ) -> None:
        self._identifier = identifier
        self._jump_ns = round(identifier.settings.time_jump * 1e9)
        self._add = add
        self._on_offset = on_offset
        self._early: tuple[int, Values] | None = None
        self._after_ns = 0
        self._place = 0

    def add(
        self,
        stamp_ns: int | None,  # Its own time, ns; None if it carries none
        arrival_ns: int,  # When it arrived, by the node's clock, ns
        values: Values,  # What `add` takes
    ) -> Drop | None:
        """Take values of a message; return why not, or None."""
        if stamp_ns is not None:
            return self._add(stamp_ns, values)
        newest_ns = self._identifier.intake.newest_ns
        if newest_ns is not None:
            self.settle()
            return self._add(self._stamp(arrival_ns, newest_ns), values)
        drop = self._add(arrival_ns, values)
        if drop is None:
            self._early = arrival_ns, values
        return drop

    def settle(self) -> None:
        """Place what came before the Imu did; to be called before a tick is computed."""
        newest_ns = self._identifier.intake.newest_ns
        if self._early is None or newest_ns is None:
            return
        (arrival_ns, values), self._early = self._early, None
        stamp_ns = self._stamp(arrival_ns, newest_ns)
        if stamp_ns != arrival_ns:  # else it is there already
            self._add(stamp_ns, values)

    def _stamp(self, arrival_ns: int, newest_ns: int) -> int:
        off_ns = arrival_ns - newest_ns
        if abs(off_ns) <= self._jump_ns:
            return arrival_ns
        if self._on_offset is not None:
            self._on_offset(off_ns * 1e-9)
            self._on_offset = None
        # Of several after one sample each has a stamp of its own: the last one counts.
        self._place = self._place + 1 if newest_ns == self._after_ns else 1
        self._after_ns = newest_ns
        return newest_ns + self._place


class Feed:
    """Gives an identifier the messages of one stream, and counts those that it does not get."""

    def __init__(
        self,
        stream: Stream,  # What the messages are
        identifier: OnlineIdentifier,  # Takes what is in them
        decode: Callable[[bytes], Any],  # Bytes to a message; it may raise `ChannelError`
        # Told the reason, as it is counted, and the words, where a message is not used
        warn: Callable[[str, str], object] = lambda reason, words: None,
        # Told once, in s, how far messages that carry no time arrive from the Imu's stamps
        on_offset: Callable[[float], None] | None = None,
    ) -> None:
        self.stream = stream
        self.type_name = stream.type_of(identifier.settings)
        self.reader: Any = stream.reader(identifier.settings)
        self.received = 0  # Messages, good or bad
        self.details: dict[str, str] = {}  # What was wrong with the last one of each reason
        self._identifier, self._decode, self._warn = identifier, decode, warn
        self._refused: Counter[str] = Counter()
        self._arrivals = Arrivals(identifier, self._add, on_offset) if stream.any_clock else None

    def take(
        self,
        data: bytes,  # A message
        arrival_ns: int,  # When it arrived, by the clock of the node or of the recorder, ns
    ) -> tuple[int, Any] | None:
        """Give the identifier a message; return stamp, ns, and values if it took them."""
        self.received += 1
        try:
            stamp_ns, values = self._read(data)
        except ChannelError as error:
            self._refused[error.reason] += 1
            self.details[error.reason] = str(error)
            self._warn(error.reason, str(error))
            return None
        t_ns = arrival_ns if stamp_ns is None else stamp_ns
        if self._arrivals is None:
            drop = self._add(t_ns, values)
        else:
            drop = self._arrivals.add(stamp_ns, arrival_ns, values)
        if drop is None:
            return t_ns, values
        self._warn(drop.value, drop.value)
        return None

    def _add(self, stamp_ns: int, values: Any) -> Any:
        return self.stream.add(self._identifier, stamp_ns, values)

    def _read(self, data: bytes) -> Reading:
        if len(data) > LARGEST_MESSAGE:
            words = f"it takes {len(data)} bytes: is it {self.type_name} at all?"
            raise ChannelError(words, "too large")
        # Decoding an Imu here costs a fraction of making a message object of it.
        imu = decode_imu_cdr(data) if self.type_name == IMU_TYPE else None
        read: Reading = self.reader.checked(imu) if imu else self.reader(self._decode(data))
        return read

    def settle(self) -> None:
        """Place what came before the Imu did; to be called before a tick is computed."""
        if self._arrivals is not None:
            self._arrivals.settle()

    def drops(self) -> Counter[str]:
        """Return what was refused here or dropped by the identifier, by reason."""
        dropped = self._identifier.intake.drops[self.stream.name]
        return self._refused + Counter({drop.value: n for drop, n in dropped.items()})
