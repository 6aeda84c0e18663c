# SPDX-License-Identifier: Apache-2.0
"""Mixing of a vehicle's raw actuator channels: ``u = mixing (raw - trim)``.

Signs of the inputs throughout the simulation: elevator trailing edge down is positive
(nose down), aileron positive rolls right, rudder trailing edge left is positive (yaws left).
"""

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.structure import FloatArray


@dataclass(frozen=True, eq=False)
class ChannelSet:
    """Raw channels of one kind of vehicle."""

    names: tuple[str, ...]  # Names of the C channels
    # (C, 4) Matrix from the total inputs de, dr, da, dth (trim included) to the raw channels
    allocation: FloatArray
    offset: FloatArray | float = 0.0  # (C,) Raw values at zero inputs

    @property
    def mixing(self) -> FloatArray:
        """M of ``u = M (raw - trim)``, shape (4, C): pseudoinverse of the allocation."""
        return np.linalg.pinv(self.allocation)

    def raw(self, inputs: FloatArray, input_trim: FloatArray) -> FloatArray:
        """Return raw channels, shape (M, C), for deviations (M, 4) from the trim (4,)."""
        return np.asarray(self.offset + (inputs + input_trim) @ self.allocation.T)

    def trim(self, input_trim: FloatArray) -> FloatArray:
        """Return the raw channels in trimmed flight, shape (C,)."""
        return np.asarray(self.offset + self.allocation @ input_trim)

    def inputs(self, raw: FloatArray, input_trim: FloatArray) -> FloatArray:
        """Return deviations de, dr, da, dth, shape (M, 4), for raw channels (M, C)."""
        return (raw - self.trim(input_trim)) @ self.mixing.T


PLAIN = ChannelSet(("elevator", "rudder", "aileron", "throttle"), np.eye(4))
"""One channel per input, rad and 0..1."""

ELEVON = ChannelSet(
    ("elevon_left", "elevon_right", "rudder", "throttle"),
    # Trailing edge down is positive on both sides; left down with right up rolls right.
    np.array(
        [
            [1.0, 0.0, 1.0, 0.0],
            [1.0, 0.0, -1.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
)
"""Two elevons: de = (left + right) / 2, da = (left - right) / 2."""

QUADROTOR = ChannelSet(
    ("motor_front_right", "motor_rear_left", "motor_front_left", "motor_rear_right"),
    # Motors 0..1, hover near 0.5 (the throttle trim). More front thrust pitches up, more left
    # thrust rolls right. The first two turn counter-clockwise: their torque yaws right.
    np.array(
        [
            [-0.5, -0.5, -0.5, 1.0],
            [0.5, -0.5, 0.5, 1.0],
            [-0.5, 0.5, 0.5, 1.0],
            [0.5, 0.5, -0.5, 1.0],
        ]
    ),
)
"""Four motors in X: differences for pitch, yaw and roll, and the collective."""

PWM = ChannelSet(
    ("servo_1", "servo_2", "servo_3", "servo_4"),
    # 1500 us is the centre, +-0.5 rad is +-500 us, the elevator servo is reversed; the throttle
    # ranges from 1000 to 2000 us.
    np.diag([-1000.0, 1000.0, 1000.0, 1000.0]),
    np.array([1500.0, 1500.0, 1500.0, 1000.0]),
)
"""Servo pulse widths, microseconds, elevator reversed."""

CHANNEL_SETS = {"plain": PLAIN, "elevon": ELEVON, "quadrotor": QUADROTOR, "pwm": PWM}
"""The channel sets by name."""
