# SPDX-License-Identifier: Apache-2.0
"""Import of Blackbox logs of quadrotors."""

from pathlib import Path

import blackbox_writing
import numpy as np
import pytest
from blackbox_writing import ACC, COUNT, FIELDS, GYRO, MOTORS, T_US, blackbox
from good_logs import written
from imported import Importer

from uav_ident_ros.import_logs.cli import DAMAGED


def log_of(importer: Importer, content: bytes) -> Path:
    return written(importer.folder / "log.bbl", content)


def test_a_betaflight_log_holds_samples_and_mixing_of_the_quadrotor(importer: Importer) -> None:
    log = written(importer.folder / "LOG00001.BFL", blackbox(50) + blackbox())
    found, values, printed = importer(log)
    assert len(found.imu_t_ns) >= COUNT - 1  # orangebox omits a frame before the end
    kept = slice(0, len(found.imu_t_ns))
    np.testing.assert_array_equal(found.imu_t_ns, T_US[kept] * 1000)
    np.testing.assert_allclose(found.rates, np.radians(GYRO[kept]), rtol=1e-12)
    np.testing.assert_allclose(found.specific_force, ACC[kept] * 9.80665 / 2048, rtol=1e-12)
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
    assert "gyroADC is low-passed at 150 Hz (gyro_lowpass_hz) by the autopilot" in printed
    assert "Betaflight 4.4.2" in printed


def test_reversed_propellers_reverse_the_yaw_mixing(importer: Importer) -> None:
    values = importer(log_of(importer, blackbox(yaw_motors_reversed=1))).values
    np.testing.assert_allclose(values["actuators.mixing.dr"], [-0.5, 0.5, 0.5, -0.5])


def test_accelerometer_off_gives_zeros(importer: Importer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Betaflight then logs zeros, and acc_1G may be 0: the force is zero, not NaN."""
    for scale, spoilt in ((0, ACC), (2048, 0 * ACC)):
        monkeypatch.setattr(blackbox_writing, "ACC", spoilt)
        found, values, printed = importer(log_of(importer, blackbox(acc_1G=scale)))
        assert "the accelerometer (accSmooth) is off" in printed
        assert values["structure"] == "throttle_coupled"
        assert not np.any(found.specific_force)


def test_motors_below_the_least_command_keep_their_values(
    importer: Importer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The difference from the least command is negative, but logged as unsigned."""
    standing = MOTORS.copy()
    standing[:100] = 0
    monkeypatch.setattr(blackbox_writing, "MOTORS", standing - [138, 0, 0, 0])
    predictors = ["0"] * len(FIELDS)
    predictors[FIELDS.index("motor[0]")] = "11"  # the difference from motorOutput
    headers = {"motorOutput": "138,2047", "Field I predictor": ",".join(predictors)}
    found = importer(log_of(importer, blackbox(**headers))).bag
    np.testing.assert_array_equal(found.actuators, standing[: len(found.actuators)])


def test_the_motor_range_of_old_firmware_is_the_throttle_range(importer: Importer) -> None:
    old = blackbox().replace(b"motorOutput:48,2047", b"minthrottle:1100\nH maxthrottle:1900")
    _, values, printed = importer(log_of(importer, old))
    assert values["actuators.scale"] == [1.0 / 800] * 4
    assert "motor of quad x, 1100 to 1900 counts" in printed


def test_an_odd_firmware_name_leaves_the_parameter_file_valid(importer: Importer) -> None:
    """The name is part of a comment in the parameter file, which must be valid YAML."""
    odd = "Beta\x01flight\x07" + "x" * 900
    _, values, printed = importer(log_of(importer, blackbox(**{"Firmware revision": odd})))
    assert "log.bbl: Beta?flight?xxx" in printed
    assert "x" * 130 not in printed
    assert values["imu.convention"] == "flu"


def test_a_truncated_or_damaged_log_loses_its_damaged_frames_alone(importer: Importer) -> None:
    whole, half = blackbox(), len(blackbox()) // 2
    found, _, printed = importer(log_of(importer, whole[:half]))
    assert "cut off at its end" in printed
    assert len(found.imu_t_ns) > COUNT // 3
    spoilt = whole[:half] + b"\xff" * 60 + whole[half + 60 :]
    found, _, printed = importer(log_of(importer, spoilt), status=DAMAGED)
    assert "orangebox skipped 2 place(s) of the file that it could not read as a frame" in printed
    assert "3 of 600 frames are missing or damaged, in 1 places" in printed
    assert len(found.imu_t_ns) == COUNT - 3


def test_lost_frames_a_disarm_event_and_filling_are_no_damage(importer: Importer) -> None:
    """The logger may lose frames, and orangebox does not know the event before the end."""
    end = len(b"E\xffEnd of log\0")
    whole, until, behind = blackbox(), len(blackbox(300)) - end, len(blackbox(301)) - end
    lost = whole[:until] + whole[behind:-end]
    for rest, count in ((whole[-end:], 600), (b"E\x0f\4" + whole[-end:], 600), (b"\xff" * 99, 599)):
        found, _, printed = importer(log_of(importer, lost + rest))
        assert f"1 of {count} frames are missing or damaged, in 1 places" in printed
        assert len(found.imu_t_ns) == count - 1
