# SPDX-License-Identifier: Apache-2.0
"""Blackbox logs of a quadrotor, encoded as Betaflight does: intra frames of variable bytes."""

import numpy as np

COUNT = 600
T_US = 1_000_000 + 2000 * np.arange(COUNT)
CHANCE = np.random.default_rng(4)
GYRO = CHANCE.integers(-300, 300, (COUNT, 3))
ACC = CHANCE.integers(-500, 500, (COUNT, 3)) + np.array([0, 0, 2048])
MOTORS = CHANCE.integers(300, 1500, (COUNT, 4))
FIELDS = [
    "loopIteration",
    "time",
    *(f"gyroADC[{i}]" for i in range(3)),
    *(f"accSmooth[{i}]" for i in range(3)),
    *(f"motor[{i}]" for i in range(4)),
]
SIGNED = [0, 0, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0]


def variable(value: int, signed: int) -> bytes:
    """Encode seven bits a byte, least significant first; signed values by zigzag."""
    number = (value << 1) ^ (value >> 31) if signed else value
    number &= 0xFFFFFFFF
    result = bytearray()
    while number > 127:
        result.append(number & 127 | 128)
        number >>= 7
    return bytes([*result, number])


def blackbox(count: int = COUNT, fields: list[str] = FIELDS, **others: object) -> bytes:
    """Return one log: headers and frames."""
    kept = [FIELDS.index(name) for name in fields]
    signed = [SIGNED[i] for i in kept]
    headers = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock",
        "Data version": 2,
        "I interval": 1,
        "P interval": "1/1",
        "Firmware type": "Cleanflight",
        "Firmware revision": "Betaflight 4.4.2 (23d066d08) STM32F405",
        "Field I name": ",".join(fields),
        "Field I signed": ",".join(map(str, signed)),
        "Field I predictor": ",".join("0" for _ in fields),
        "Field I encoding": ",".join(str(1 - sign) for sign in signed),
        "gyro_scale": "0x3f800000",
        "acc_1G": 2048,
        "motorOutput": "48,2047",
        "gyro_lowpass_hz": 150,
    } | others
    content = "".join(f"H {name}:{value}\n" for name, value in headers.items()).encode()
    rows = np.column_stack([np.arange(COUNT), T_US, GYRO, ACC, MOTORS])[:count, kept]
    for row in rows.tolist():
        content += b"I" + b"".join(variable(v, s) for v, s in zip(row, signed, strict=True))
    return content + b"E\xffEnd of log\x00"
