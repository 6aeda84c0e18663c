# SPDX-License-Identifier: Apache-2.0
"""Blackbox logs of quadrotors, and those that cannot be used."""

from pathlib import Path

import numpy as np
from blackbox_writing import ACC, COUNT, FIELDS, GYRO, MOTORS, T_US, blackbox
from imported import Importer
from programs import python


def written(importer: Importer, content: bytes) -> Path:
    path = importer.folder / "log.bbl"
    path.write_bytes(content)
    return path


def test_a_quadrotor_of_betaflight(importer: Importer) -> None:
    log = importer.folder / "LOG00001.BFL"
    log.write_bytes(blackbox(50) + blackbox())
    found, values, printed = importer(log)
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
    assert "log 2 of 2 in this file, the longest" in printed
    assert "gyroADC is behind the filters (low-pass at 150 Hz)" in printed
    assert "Betaflight 4.4.2" in printed


def test_reversed_propellers(importer: Importer) -> None:
    values = importer(written(importer, blackbox(yaw_motors_reversed=1))).values
    np.testing.assert_allclose(values["actuators.mixing.dr"], [-0.5, 0.5, 0.5, -0.5])


def test_a_firmware_with_an_odd_name(importer: Importer) -> None:
    """It stands in a comment of the parameter file, which must be YAML."""
    odd = "Beta\x01flight\x07" + "x" * 900
    _, values, printed = importer(written(importer, blackbox(**{"Firmware revision": odd})))
    assert "log.bbl: Beta?flight?xxx" in printed
    assert "x" * 130 not in printed
    assert values["imu.convention"] == "flu"


def test_a_log_that_is_cut_off(importer: Importer) -> None:
    whole = blackbox()
    found, _, printed = importer(written(importer, whole[: len(whole) // 2]))
    assert "cut off at its end" in printed
    assert len(found.imu_t_ns) > COUNT // 3


def test_blackboxes_that_cannot_be_used(importer: Importer) -> None:
    six = blackbox(fields=FIELDS[:-1])
    none = blackbox(fields=[name for name in FIELDS if not name.startswith("gyro")])
    for content, words in (
        (six, "has 3 motors: only quadrotors are known"),
        (none, "has no rates (gyroADC); it has time"),
        (blackbox(0), "has no frames that can be read"),
    ):
        assert words in importer.refused(written(importer, content))


def test_without_orangebox_its_extra_is_named(tmp_path: Path) -> None:
    (tmp_path / "log.bbl").write_bytes(blackbox(50))
    program = (
        "import sys; sys.modules['orangebox'] = None\n"
        "from uav_ident_ros.import_logs.cli import main\n"
        f"sys.exit(main([{str(tmp_path / 'log.bbl')!r}, '--output', {str(tmp_path / 'bag')!r}]))"
    )
    done = python("-c", program)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "orangebox is not installed" in line
    assert "uav_ident_ros[blackbox]" in line
