# SPDX-License-Identifier: Apache-2.0
"""Axes of the Imu and the lever arm, against independent formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uav_ident_ros.identification.frames import (
    BodyFrame,
    centripetal,
    lever_arm_matrix,
    rotation,
)
from uav_ident_ros.identification.settings import ImuSettings


def test_rotation_is_roll_pitch_yaw_in_aircraft_order() -> None:
    rng = np.random.default_rng(1)
    for roll, pitch, yaw in rng.uniform(-1.5, 1.5, (50, 3)):
        reference = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        np.testing.assert_allclose(rotation(roll, pitch, yaw), reference, atol=1e-15)


def test_flu_differs_from_frd_by_half_a_turn_about_x() -> None:
    frame = BodyFrame(ImuSettings(convention="flu"))
    assert frame.to_body(np.array([1.0, 2.0, 3.0])).tolist() == [1.0, -2.0, -3.0]
    same = BodyFrame(ImuSettings(convention="frd"))
    assert same.to_body(np.array([1.0, 2.0, 3.0])).tolist() == [1.0, 2.0, 3.0]


def test_a_sensor_on_its_side_measures_pitch_as_minus_yaw() -> None:
    # rolled right by 90 degrees: the sensor's y axis points down, its z axis to the left
    frame = BodyFrame(ImuSettings(convention="frd", rpy=(np.pi / 2, 0.0, 0.0)))
    np.testing.assert_allclose(frame.to_body(np.array([0.0, 1.0, 0.0])), [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(frame.to_body(np.array([0.0, 0.0, 1.0])), [0, -1, 0], atol=1e-15)


@pytest.mark.parametrize("convention", ["flu", "frd"])
def test_there_and_back_is_the_identity(convention: str) -> None:
    frame = BodyFrame(ImuSettings(convention=convention, rpy=(0.3, -0.7, 2.0)))
    vectors = np.random.default_rng(2).normal(size=(20, 3))
    np.testing.assert_allclose(frame.to_imu(frame.to_body(vectors)), vectors, atol=1e-15)


def test_lever_arm_terms_are_the_cross_products() -> None:
    rng = np.random.default_rng(3)
    x, xdot, arm = rng.normal(size=(40, 3)), rng.normal(size=(40, 3)), rng.normal(size=3)
    swing = np.cross(x, np.cross(x, arm))[:, 1:]
    np.testing.assert_allclose(centripetal(x, arm), swing, atol=1e-14)
    tangential = np.cross(xdot, arm)[:, 1:]
    np.testing.assert_allclose(xdot @ lever_arm_matrix(arm).T, tangential, atol=1e-14)
