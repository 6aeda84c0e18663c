# SPDX-License-Identifier: Apache-2.0
"""PX4 logs for the tests, in the documented format: any topics, any parameters."""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from uav_ident_ros.import_logs.px4_log import MAGIC

ULOG_TYPES = {"float32": "float", **{f"{kind}{n}": f"{kind}{n}_t" for kind, n in
              (("int", 32), ("uint", 32), ("uint", 8), ("uint", 64))}}  # fmt: skip

Columns = Mapping[str, np.ndarray]


def message(kind: str, content: bytes) -> bytes:
    """Return one message with its header."""
    return struct.pack("<HB", len(content), ord(kind)) + content


def keyed(kind: str, key: str, value: bytes) -> bytes:
    """Return an information or parameter message."""
    return message(kind, bytes([len(key)]) + key.encode() + value)


def write_ulog(
    path: Path,  # The new file
    # Columns by topic and instance; ``timestamp`` (us) is one of them, arrays of two dimensions are
    # array fields
    topics: Mapping[tuple[str, int], Columns],
    parameters: Mapping[str, float],  # Initial parameters
    dropouts: tuple[tuple[int, int], ...] = (),  # Time (us) and length (ms) of each dropout
) -> Path:
    """Write a log; its samples are in order of time."""
    start = min(int(columns["timestamp"][0]) for columns in topics.values())
    parts = [MAGIC + b"\1" + struct.pack("<Q", start), message("B", bytes(40))]
    parts += [keyed("I", "char[3] sys_name", b"PX4"), keyed("I", "char[4] ver_hw", b"TEST")]
    rows = [(t_us, message("O", struct.pack("<H", length))) for t_us, length in dropouts]
    for name, value in parameters.items():
        kind, packed = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
        parts.append(keyed("P", f"{kind} {name}", struct.pack(packed, value)))
    added = []
    for number, ((name, instance), columns) in enumerate(topics.items()):
        fields = [f"{ULOG_TYPES[v.dtype.name]}{list(v.shape[1:]) or ''} {field};"
                  for field, v in columns.items()]  # fmt: skip
        parts.append(message("F", f"{name}:{''.join(fields)}".encode()))
        key = number.to_bytes(2, "little")
        added.append(message("A", bytes([instance]) + key + name.encode()))
        table = np.zeros(
            len(columns["timestamp"]), [(f, v.dtype, v.shape[1:]) for f, v in columns.items()]
        )
        for field, values in columns.items():
            table[field] = values
        for row in table:
            rows.append((int(row["timestamp"]), message("D", key + row.tobytes())))
    rows.sort(key=lambda row: row[0])
    path.write_bytes(b"".join([*parts, *added, *(content for _, content in rows)]))
    return path


def stamps(t_ns: np.ndarray) -> np.ndarray:
    """Return the stamps in microseconds, PX4's unit."""
    return (np.asarray(t_ns) // 1000).astype(np.uint64)


def sensor_combined(
    t_ns: np.ndarray, rates: np.ndarray, force: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the columns of sensor_combined; gyro and accelerometer share their sample times."""
    count = len(t_ns)
    return {
        "timestamp": stamps(t_ns),
        "gyro_rad": rates.astype(np.float32),
        "gyro_integral_dt": np.full(count, 5000, np.uint32),
        "accelerometer_timestamp_relative": np.zeros(count, np.int32),
        "accelerometer_m_s2": force.astype(np.float32),
    }


def commands(
    t_ns: np.ndarray, values: np.ndarray, field: str, delay_us: int = 0
) -> dict[str, np.ndarray]:
    """Return the columns of a topic of commands, published `delay_us` after their gyro sample."""
    published = stamps(t_ns)
    return {
        "timestamp": published,
        "timestamp_sample": published - np.uint64(delay_us),
        field: values.astype(np.float32),
    }


def padded(values: np.ndarray, size: int) -> np.ndarray:
    """Append columns of unused entries: NaN, as in PX4."""
    unused = np.full((len(values), size - values.shape[1]), np.nan)
    return np.hstack([values, unused])
