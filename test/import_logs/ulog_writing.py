# SPDX-License-Identifier: Apache-2.0
"""PX4 logs for the tests, written by pyulog itself: any topics, any parameters."""

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from pyulog import ULog

ULOG_TYPES = {
    np.dtype(np.float32): "float",
    np.dtype(np.int32): "int32_t",
    np.dtype(np.uint32): "uint32_t",
    np.dtype(np.uint8): "uint8_t",
    np.dtype(np.uint64): "uint64_t",
}

Columns = Mapping[str, np.ndarray]


def write_ulog(
    path: Path,  # The new file
    # Columns by topic and instance; ``timestamp`` (us) is one of them, arrays of two dimensions are
    # array fields
    topics: Mapping[tuple[str, int], Columns],
    parameters: Mapping[str, float],  # Initial parameters
    dropouts: tuple[tuple[int, int], ...] = (),  # Time (us) and length (ms) of each dropout
) -> Path:
    """Write a log."""
    log = ULog(None)
    log._start_timestamp = min(int(c["timestamp"][0]) for c in topics.values())
    log._initial_parameters = dict(parameters)
    log._msg_info_dict = {"sys_name": "PX4", "ver_hw": "TEST"}
    log._msg_info_dict_types = {"sys_name": "char[3]", "ver_hw": "char[4]"}
    for number, ((name, instance), columns) in enumerate(topics.items()):
        log._message_formats[name] = ULog.MessageFormat(_format(name, columns), None)
        added = b"%c" % instance + number.to_bytes(2, "little") + name.encode()
        subscription = ULog._MessageAddLogged(added, None, log._message_formats)
        subscription.buffer = _rows(columns, subscription.dtype)
        log._data_list.append(ULog.Data(subscription))
    for timestamp, duration in dropouts:
        log._dropouts.append(SimpleNamespace(timestamp=timestamp, duration=duration))
    log.write_ulog(str(path))
    return path


def _format(name: str, columns: Columns) -> bytes:
    fields = []
    for field, values in columns.items():
        kind = ULOG_TYPES[values.dtype]
        size = f"[{values.shape[1]}]" if values.ndim == 2 else ""
        fields.append(f"{kind}{size} {field};")
    return f"{name}:{''.join(fields)}".encode()


def _rows(columns: Columns, dtype: np.dtype) -> bytes:
    table = np.zeros(len(columns["timestamp"]), dtype)
    for field, values in columns.items():
        if values.ndim == 1:
            table[field] = values
        else:
            for i in range(values.shape[1]):
                table[f"{field}[{i}]"] = values[:, i]
    return table.tobytes()


def stamps(t_ns: np.ndarray) -> np.ndarray:
    """Microseconds, as PX4 stamps."""
    return (np.asarray(t_ns) // 1000).astype(np.uint64)


def sensor_combined(
    t_ns: np.ndarray, rates: np.ndarray, force: np.ndarray
) -> dict[str, np.ndarray]:
    """Columns of sensor_combined; the accelerometer is sampled with the gyro."""
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
    """Columns of a topic of commands, published some time after the sample they answer."""
    published = stamps(t_ns)
    return {
        "timestamp": published,
        "timestamp_sample": published - np.uint64(delay_us),
        field: values.astype(np.float32),
    }


def padded(values: np.ndarray, size: int) -> np.ndarray:
    """Columns of unused entries behind the used ones: NaN, as PX4 leaves them."""
    unused = np.full((len(values), size - values.shape[1]), np.nan)
    return np.hstack([values, unused])
