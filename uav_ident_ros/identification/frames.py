# SPDX-License-Identifier: Apache-2.0
"""Rotation from the Imu's axes to the body axes, and effects of the lever arm."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.settings import ImuSettings
from uav_ident_ros.identification.structure import FloatArray

_FLU_TO_FRD = np.diag([1.0, -1.0, -1.0])
# (3, 9) The matrix of each unit vector that multiplies by it as a cross product
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2).reshape(3, 9)


def rotation(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Return the rotation matrix Rz(yaw) Ry(pitch) Rx(roll), shape (3, 3), angles in rad."""
    cr, sr = np.cos(roll), np.sin(roll)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def euler_angles(matrix: FloatArray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw, rad, of a rotation matrix as by `rotation`."""
    roll, yaw = np.arctan2(matrix[2, 1], matrix[2, 2]), np.arctan2(matrix[1, 0], matrix[0, 0])
    return float(roll), float(-np.arcsin(np.clip(matrix[2, 0], -1.0, 1.0))), float(yaw)


class BodyFrame:
    """Rotation of vectors between the Imu's own axes and the body axes FRD."""

    def __init__(self, settings: ImuSettings) -> None:
        convention = _FLU_TO_FRD if settings.convention == "flu" else np.eye(3)
        self._to_body: FloatArray = rotation(*settings.rpy) @ convention

    def to_body(self, vectors: FloatArray) -> FloatArray:
        """Rotate vectors of shape (..., 3) from the Imu's axes to FRD."""
        flat = vectors.reshape(-1, 3) @ self._to_body.T  # one product for all of them
        return np.asarray(flat.reshape(vectors.shape))

    def to_imu(self, vectors: FloatArray) -> FloatArray:
        """Rotate vectors of shape (..., 3) from FRD to the Imu's axes."""
        return np.asarray(vectors @ self._to_body)


def lever_arm_matrix(arm: FloatArray) -> FloatArray:
    """Return the matrix L with ``(omega_dot x arm)_{y,z} = L omega_dot``, shape (2, 3), m."""
    x, y, z = arm
    return np.array([[-z, 0.0, x], [y, -x, 0.0]])


def centripetal(
    x: FloatArray,  # (..., 3) Rates p, q, r, rad/s, FRD
    arm: FloatArray,  # (3,) Position of the accelerometer from the centre of gravity, m, FRD
) -> FloatArray:
    """Return components y and z of ``omega x (omega x arm)``, (..., 2), m/s^2."""
    p, q, r = x[..., 0], x[..., 1], x[..., 2]
    along = p * arm[0] + q * arm[1] + r * arm[2]
    square = p * p + q * q + r * r
    return np.stack([q * along - square * arm[1], r * along - square * arm[2]], axis=-1)


def quaternions(
    roll: FloatArray | float, pitch: FloatArray | float, yaw: FloatArray | float
) -> FloatArray:
    """Return the unit quaternions x, y, z, w of Euler angles (rad), shape (..., 4)."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (np.cos(angle / 2.0), np.sin(angle / 2.0)) for angle in (roll, pitch, yaw)
    )
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return np.stack([x, y, z, w], axis=-1)


def rotations(vectors: FloatArray) -> FloatArray:
    """Return the rotation matrices, (..., 3, 3), of rotation vectors, (..., 3), rad (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    cross = cross_matrices(vectors / np.maximum(angle, 1e-12))
    sine, versine = np.sin(angle)[..., None], 1.0 - np.cos(angle)[..., None]
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return the matrices, (..., 3, 3), that multiply by vectors, (..., 3), as a cross product."""
    return np.asarray((vectors @ _CROSS).reshape(*vectors.shape, 3))


def attitudes(
    steps: FloatArray,  # (k,) Duration of each sample, s
    rates: FloatArray,  # (..., k, 3) Angular rates, rad/s, constant over each sample
) -> FloatArray:
    """Return the rotations, (..., k, 3, 3), from the axes after each sample to the initial ones."""
    turns = rotations(rates * steps[:, None])
    reach = 1
    while reach < len(steps):  # cumulative products, by doubling
        turns[..., reach:, :, :] = turns[..., :-reach, :, :] @ turns[..., reach:, :, :]
        reach *= 2
    return turns
