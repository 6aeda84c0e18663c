# SPDX-License-Identifier: Apache-2.0
"""Many serialized Imu messages at a time: one array operation in place of a decoder each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.imu import decode_imu_cdr
from uav_ident_ros.messages.types import NS_PER_S, RatesReading

# Places in the bytes: encapsulation, stamp, frame_id with its length; then, aligned, the doubles
# orientation with covariance, rates with covariance, force with covariance.
_ENCAPSULATION = 4
_STAMP = slice(4, 12)
_FRAME = 12
_BEFORE_FRAME = 12  # stamp and length, from which the body's alignment counts
_DOUBLES = 37
_RATES, _RATES_COVARIANCE = slice(13, 16), 16
_FORCE, _FORCE_COVARIANCE = slice(25, 28), 28
_NOT_MEASURED = -1.0
_LITTLE_ENDIAN = b"\x00\x01"


class ImuBlock(NamedTuple):
    """Imu messages that differ in nothing but their stamps and numbers."""

    t_ns: TimeArray  # (k,) Stamps, ns
    # (k, 6) Angular velocity, rad/s, and specific force, m/s^2, in the sensor's axes; a force that
    # is not measured is zero
    values: FloatArray
    frame_id: str  # Frame of all of them


def decode_imu_block(
    messages: Sequence[bytes],  # At least one message, with its encapsulation header
) -> ImuBlock | None:
    """Read serialized sensor_msgs/msg/Imu messages.

    Returns
    -------
    ImuBlock or None
        None if they are not all alike, or some do not measure the rates: read them one by one.
    """
    first = messages[0]
    reading: RatesReading | None = decode_imu_cdr(first)
    size = len(first)
    if reading is None or first[:2] != _LITTLE_ENDIAN or any(len(m) != size for m in messages):
        return None
    rows = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(len(messages), size)
    length = int.from_bytes(first[_FRAME : _FRAME + 4], "little")
    frame = slice(_FRAME, _FRAME + 4 + length)
    begin = ((_BEFORE_FRAME + length + 7) & -8) + _ENCAPSULATION
    for part in (slice(_ENCAPSULATION), frame):
        if not (rows[:, part] == rows[0, part]).all():
            return None
    doubles = np.ascontiguousarray(rows[:, begin : begin + 8 * _DOUBLES]).view("<f8")
    if (doubles[:, _RATES_COVARIANCE] == _NOT_MEASURED).any():
        return None
    stamps = np.ascontiguousarray(rows[:, _STAMP])
    t_ns = stamps[:, :4].copy().view("<i4")[:, 0].astype(np.int64) * NS_PER_S
    t_ns += stamps[:, 4:].copy().view("<u4")[:, 0]
    force = doubles[:, _FORCE]
    measured = doubles[:, _FORCE_COVARIANCE, None] != _NOT_MEASURED
    values = np.hstack([doubles[:, _RATES], np.where(measured, force, 0.0)])
    return ImuBlock(t_ns, values, reading.frame_id)
