# SPDX-License-Identifier: Apache-2.0
"""Axes of the Imu and the lever arm, against independent formulas."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uav_ident_ros.identification.frames import BodyFrame, rotation
from uav_ident_ros.identification.settings import ImuSettings


def test_rotation_is_roll_pitch_yaw_in_aircraft_order() -> None:
    rng = np.random.default_rng(1)
    for roll, pitch, yaw in rng.uniform(-1.5, 1.5, (50, 3)):
        reference = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        np.testing.assert_allclose(rotation(roll, pitch, yaw), reference, atol=1e-15)


@pytest.mark.parametrize(("convention", "expected"), [("frd", [1, 2, 3]), ("flu", [1, -2, -3])])
def test_flu_differs_from_frd_by_half_a_turn_and_a_turn_has_an_inverse(
    convention: str, expected: list[int]
) -> None:
    frame = BodyFrame(ImuSettings(convention=convention))
    assert frame.to_body(np.array([1.0, 2.0, 3.0])).tolist() == expected
    frame = BodyFrame(ImuSettings(convention=convention, rpy=(0.3, -0.7, 2.0)))
    vectors = np.random.default_rng(2).normal(size=(20, 3))
    np.testing.assert_allclose(frame.to_imu(frame.to_body(vectors)), vectors, atol=1e-15)
