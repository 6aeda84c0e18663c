# SPDX-License-Identifier: Apache-2.0
"""A valid log of each kind, for tests to damage."""

from pathlib import Path

import numpy as np
from dataflash_writing import write_dataflash
from ulog_writing import commands, sensor_combined, stamps, write_ulog

IMU_NS = 5_000_000 * np.arange(1, 2001)
VALUES = np.random.default_rng(1).normal(size=(len(IMU_NS), 3))
COMMANDS = commands(IMU_NS[::4], VALUES[::4], "xyz")
RATES = sensor_combined(IMU_NS, VALUES, VALUES)
GOOD = {("sensor_combined", 0): RATES, ("vehicle_torque_setpoint", 0): COMMANDS}
ARMED = {("vehicle_status", 0): {
    "timestamp": stamps(IMU_NS[:2]), "arming_state": np.full(2, 2, np.uint8)
}}  # fmt: skip

COLUMNS = """\
time: {column: t}
axes: frd
rates: {columns: [p, q, r], unit: rad/s}
channels:
  elevator: {column: de, de: 1.0}
"""
TABLE = "t,p,q,r,de\n" + "".join(f"{0.01 * i:.2f},0.1,0.2,0.3,{0.01 * i}\n" for i in range(300))


def written(path: Path, content: bytes) -> Path:
    """Write a file with this content; return its path."""
    path.write_bytes(content)
    return path


def ulog(folder: Path, share: float = 1.0) -> Path:
    """Write a PX4 log, or its first part; return its path."""
    topics = {
        key: {field: v[: int(share * len(v))] for field, v in columns.items()}
        for key, columns in GOOD.items()
    }
    return write_ulog(folder / "good.ulg", topics | ARMED, {"CA_AIRFRAME": 0})


def plane_log(
    folder: Path, *left_out: str, servos: tuple[int, ...] = (4, 19), share: float = 1.0
) -> Path:
    """Write an ArduPilot log, or its first part; return its path."""
    functions = {f"SERVO{i}_FUNCTION": function for i, function in enumerate(servos, 1)}
    count = int(share * len(IMU_NS))
    rows = [
        (int(t) // 1000, "IMU", (0, *v, *v))
        for t, v in zip(IMU_NS[:count], VALUES[:count], strict=True)
    ]
    rows += [(int(t) // 1000, "RCOU", (1500, 1500 + i % 9)) for i, t in enumerate(IMU_NS[:count:4])]
    rows = [row for row in rows if row[1] not in left_out]
    return write_dataflash(folder / "plane.bin", rows, functions)


def table(folder: Path, text: str = TABLE, columns: str = COLUMNS) -> list[str]:
    """Write a table and its column map; return the arguments that import it."""
    (folder / "flight.csv").write_text(text, encoding="utf-8")
    (folder / "columns.yaml").write_text(columns, encoding="utf-8")
    return [str(folder / "flight.csv"), "--columns", str(folder / "columns.yaml")]
