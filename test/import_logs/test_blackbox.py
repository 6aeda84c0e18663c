# SPDX-License-Identifier: Apache-2.0
"""Blackbox logs of a quadrotor, encoded as Betaflight does: intra frames of variable bytes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from imported import contents, parameters, refusal, run

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
    """Seven bits a byte, the least first; signed ones zigzag."""
    number = (value << 1) ^ (value >> 31) if signed else value
    number &= 0xFFFFFFFF
    result = bytearray()
    while number > 127:
        result.append(number & 127 | 128)
        number >>= 7
    return bytes([*result, number])


def blackbox(count: int = COUNT, fields: list[str] = FIELDS, **others: object) -> bytes:
    """One log: headers and frames."""
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


def test_a_quadrotor_of_betaflight(tmp_path: Path, capsys) -> None:
    log = tmp_path / "LOG00001.BFL"
    log.write_bytes(blackbox(50) + blackbox())
    said = run([str(log), "--output", str(tmp_path / "bag")], capsys)
    found, values = contents(tmp_path / "bag"), parameters(tmp_path / "bag")
    assert len(found.imu_t_ns) >= COUNT - 1  # orangebox leaves out a frame before the end
    kept = slice(0, len(found.imu_t_ns))
    np.testing.assert_array_equal(found.imu_t_ns, T_US[kept] * 1000)
    np.testing.assert_allclose(found.rates, np.radians(GYRO[kept]), rtol=1e-12)
    np.testing.assert_allclose(found.force, ACC[kept] * 9.80665 / 2048, rtol=1e-12)
    np.testing.assert_array_equal(found.actuators, MOTORS[kept])
    assert found.frame_ids == {"base_link"}
    assert values["imu.convention"] == "flu"
    assert values["structure"] == "augmented"
    assert values["actuators.scale"] == [1.0 / 1999] * 4
    # rear right, front right, rear left, front left; clockwise propellers yaw left
    np.testing.assert_allclose(values["actuators.mixing.da"], [-0.5, -0.5, 0.5, 0.5])
    np.testing.assert_allclose(values["actuators.mixing.de"], [0.5, -0.5, 0.5, -0.5])
    np.testing.assert_allclose(values["actuators.mixing.dr"], [0.5, -0.5, -0.5, 0.5])
    assert "log 2 of 2 in this file, the longest" in said
    assert "gyroADC is behind the filters (low-pass at 150 Hz)" in said
    assert "Betaflight 4.4.2" in said


def test_reversed_propellers(tmp_path: Path, capsys) -> None:
    (tmp_path / "log.bbl").write_bytes(blackbox(yaw_motors_reversed=1))
    run([str(tmp_path / "log.bbl"), "--output", str(tmp_path / "bag")], capsys)
    values = parameters(tmp_path / "bag")
    np.testing.assert_allclose(values["actuators.mixing.dr"], [-0.5, 0.5, 0.5, -0.5])


def test_a_log_that_is_cut_off(tmp_path: Path, capsys) -> None:
    whole = blackbox()
    (tmp_path / "cut.bbl").write_bytes(whole[: len(whole) // 2])
    said = run([str(tmp_path / "cut.bbl"), "--output", str(tmp_path / "bag")], capsys)
    assert "cut off at its end" in said
    assert len(contents(tmp_path / "bag").imu_t_ns) > COUNT // 3


def test_blackboxes_that_cannot_be_used(tmp_path: Path, capsys) -> None:
    six = blackbox(fields=FIELDS[:-1])
    none = blackbox(fields=[name for name in FIELDS if not name.startswith("gyro")])
    for content, words in (
        (six, "has 3 motors: only quadrotors are known"),
        (none, "has no rates (gyroADC); it has time"),
        (blackbox(0), "has no frames that can be read"),
    ):
        (tmp_path / "log.bbl").write_bytes(content)
        assert words in refusal([str(tmp_path / "log.bbl"), "--output", "nowhere"], capsys)


def test_without_orangebox_its_extra_is_named(tmp_path: Path) -> None:
    (tmp_path / "log.bbl").write_bytes(blackbox(50))
    program = (
        "import sys; sys.modules['orangebox'] = None\n"
        "from uav_ident_ros.import_logs.cli import main\n"
        f"sys.exit(main([{str(tmp_path / 'log.bbl')!r}, '--output', {str(tmp_path / 'bag')!r}]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "orangebox is not installed" in line
    assert "uav_ident_ros[blackbox]" in line
