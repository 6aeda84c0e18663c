# SPDX-License-Identifier: Apache-2.0
"""Gyro: its bias, and whether it fits the specific force as configured or with reversed axes.

Rotated by the gyro into one attitude, specific force f and gravity g change the velocity v::

    d(R v)/dt = R f + g

An aircraft flies along its longitudinal axis but for the flow angles, v = (V, V beta, 0). In a
Dutch roll the nose swings while the path stays: the sideslip beta is the side force over its slope.
For each hypothesis an extended Kalman filter, in information form, estimates the direction of
gravity, the bias of the gyro, and one over that slope. In turns their innovations decide (multiple
model estimation; Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, section 11.6), in straight flight the lift.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.frames import attitudes, cross_matrices
from uav_ident_ros.identification.lift import LiftSigns
from uav_ident_ros.identification.model import GRAVITY, SIDE_FORCE_SLOPE
from uav_ident_ros.identification.scales import DOUBTLESS, GRAVITY_BAND, LONG_MEMORY, SURE, TINY
from uav_ident_ros.identification.structure import FloatArray

MEAN_FORCE_SIGMA = GRAVITY_BAND * GRAVITY
"""Standard deviation of the mean specific force of a block from that of flight along the
longitudinal axis, m/s^2: the angle of attack changes as well, and gusts change both."""


class Hypothesis(NamedTuple):
    """Axes of the Imu of which the signs are wrong."""

    gyro: tuple[int, int, int]  # Sign of each axis of the gyro
    ahead: int  # Sign of the airspeed along the longitudinal axis
    problem: str = ""
    cure: str = "Correct it where the Imu is published (REP-103)"


HYPOTHESES = (
    Hypothesis((1, 1, 1), 1),
    Hypothesis(
        (1, 1, 1),
        -1,
        "the Imu points backwards, or its gyro has other axes than its accelerometer",
        "Add 3.14 to the yaw of imu.rpy, or publish both in the same axes",
    ),
    Hypothesis((-1, 1, 1), 1, "axis x or axis z of the gyro has the wrong sign"),
    Hypothesis((1, -1, 1), 1, "axis y of the gyro has the wrong sign, or all three have"),
)
"""The configured axes, then those that are compared with them. The mirror image, in which roll and
yaw rate are reversed, fits as well as each of them: so all wrong signs are covered but these two
together, which the side force shows."""

_BACKWARDS = HYPOTHESES[1]
_LEVEL = (
    Hypothesis(
        (1, 1, -1),
        1,
        "axis z of the gyro has the wrong sign, by itself or with axis x",
        "Correct it where the Imu is published (REP-103), or set imu.lever_arm if the Imu is ahead "
        "of the centre of gravity: it then feels each turn as a side force",
    ),
    Hypothesis((1, -1, 1), 1, "axis y of the gyro has the wrong sign, by itself or with axis x"),
)
"""Axes of which the signs are wrong if the side force, or the lift, alone supports the flow."""

_SIGNS = np.array([hypothesis.gyro for hypothesis in HYPOTHESES], dtype=float)[:, None]
_AHEAD = np.array([hypothesis.ahead for hypothesis in HYPOTHESES], dtype=float)[:, None]
_ALONG = cross_matrices(np.eye(3)[0])  # Cross product with the longitudinal axis
_ATTITUDE, _BIAS, _SLIP = slice(0, 3), slice(3, 6), slice(6, 7)  # States of a filter
_PRIOR = np.diag([*[GRAVITY_BAND**-2] * 6, SIDE_FORCE_SLOPE**2])
"""Information on attitude, rad^-2, gyro bias, (rad/s)^-2, and sideslip by side force, (m/s^2)^2 per
rad^2, from the first sample alone. The attitude is as sure as its gravity; a bias as large is found
in seconds; the sideslip has the prior of the identified model."""


class WrongAxes(NamedTuple):
    """Axes that fit better than the configured ones."""

    axes: Hypothesis
    sigma: float  # By how many standard deviations
    evidence: str  # What fits better, for a message


class GyroFilters:
    """Bias of the gyro of an aircraft that flies ahead, and a minute's evidence for wrong axes."""

    def __init__(self) -> None:
        self._bias: FloatArray = np.zeros((len(HYPOTHESES), 3))
        # Sideslip per side force, rad per m/s^2
        self._slip: FloatArray = np.full((len(HYPOTHESES), 1), 1.0 / SIDE_FORCE_SLOPE)
        # Sums over the blocks: squares of the innovations, in variances, and their number
        self._squares: FloatArray = np.zeros(len(HYPOTHESES))
        self._count = 0.0
        self._information: FloatArray = np.tile(_PRIOR, (len(HYPOTHESES), 1, 1))
        self._down: FloatArray | None = None  # (h, 3) Unit vectors
        # With the configured axes: bias of the rates p, q, r, rad/s, zero until it is significant,
        # and the unit vector that points down at the end of the last block, with this bias
        self.bias: FloatArray = np.zeros(3)
        self.down: FloatArray = np.eye(3)[2]
        self._lift = LiftSigns()
        self.found = False  # Whether the bias has been significant; it then stays in use

    def restart(self) -> None:
        """Begin with an unknown attitude; biases, sideslips and evidence are kept."""
        self._down = None
        covariance = np.linalg.inv(self._information)
        self._information = np.tile(_PRIOR, (len(HYPOTHESES), 1, 1))
        kept = slice(_BIAS.start, None)
        self._information[:, kept, kept] = np.linalg.inv(covariance[:, kept, kept])

    def add(
        self,
        steps: FloatArray,  # (k,) Durations of the samples, s
        rates: FloatArray,  # (k, 3) rad/s, FRD
        force: FloatArray,  # (k, 3) Specific force, m/s^2, FRD
        airspeed: float,  # True, m/s
        *,
        shows_axes: bool = True,  # Whether the flight may show the axes
        corrected: bool = False,  # Whether the force has a correction for a lever arm
    ) -> None:
        """Add a block of samples, as long as the path of flight takes to follow the nose."""
        time, speed = float(steps.sum()), (airspeed * _AHEAD)[..., None]
        omega = _SIGNS * rates - self._bias[:, None]
        turns = attitudes(steps, omega)
        # Specific force less the centripetal acceleration, in the initial axes: minus gravity
        upwards = (turns @ (force + speed * (omega @ _ALONG.T))[..., None])[..., 0]
        if self._down is None:
            self._down = -_unit(upwards.mean(axis=1))
        # A launch has another force than gravity, whatever the axes: it counts as evidence alone
        off = np.abs(np.linalg.norm(upwards, axis=2) / GRAVITY - 1.0).min(axis=0)
        weights = steps / time * np.maximum(0.0, 1.0 - off / GRAVITY_BAND)
        weight = float(weights.sum())
        shares = np.stack([steps / time, weights / (weight + TINY)])
        by_slip = np.einsum("sk,hki->shi", shares, _slipping(turns, steps, force, airspeed))
        innovation = np.einsum("sk,hki->shi", shares, upwards) + GRAVITY * self._down
        innovation -= by_slip * self._slip
        gravity = GRAVITY * (self._down[0] @ turns[0])
        if shows_axes:
            self._lift.add(steps, omega[0], force, gravity, airspeed, corrected=corrected)
        # The rotation vector, initial axes, per bias, s
        lever = np.cumsum(turns * steps[:, None, None], axis=1)
        by_bias = speed[..., None] * (turns @ _ALONG) - cross_matrices(upwards) @ lever
        by_bias = np.einsum("sk,hkij->shij", shares, by_bias)
        by_attitude = np.broadcast_to(GRAVITY * cross_matrices(self._down), by_bias.shape)
        slope = np.concatenate([by_attitude, by_bias, by_slip[..., None]], axis=3)
        scaled = innovation[0] / MEAN_FORCE_SIGMA, slope[0] / MEAN_FORCE_SIGMA
        self._judge(*scaled, 1.0 - time / LONG_MEMORY, shows_axes=shows_axes)
        weighted = weight / MEAN_FORCE_SIGMA**2 * slope[1].swapaxes(1, 2)
        information = self._information + weighted @ slope[1]
        error = np.linalg.solve(information, weighted @ innovation[1, ..., None])[..., 0]
        self._turn(turns[:, -1], lever[:, -1], error, information, time)
        self._subtract_bias()

    def _subtract_bias(self) -> None:
        """Set bias and attitude, once the bias is significant, by what the flight has shown of it.

        A component that is subtracted leaves its variance, one that is not its square.
        """
        assert self._down is not None
        covariance = np.linalg.inv(self._information[0])
        variances, directions = np.linalg.eigh(covariance[_BIAS, _BIAS])
        components = self._bias[0] @ directions
        # Innovations larger than assumed count by their ratio
        larger = max(1.0, float(self._squares[0]) / self._count)
        squares = components**2 / (larger * variances)
        self.found = self.found or bool(squares.sum() > DOUBTLESS**2)
        shown = self.found & (squares > 1.0)
        self.bias = directions @ np.where(shown, components, 0.0)
        missing = directions @ np.where(shown, 0.0, components / variances)
        turned = covariance[_ATTITUDE, _BIAS] @ missing
        self.down = _unit(self._down[0] - np.cross(turned, self._down[0]))

    def _judge(
        self, innovation: FloatArray, slope: FloatArray, keep: float, *, shows_axes: bool
    ) -> None:
        """Add the squares of the predicted innovations; their sum so far counts by `keep`.

        Where the flight shows no axes, every hypothesis gets those of the configured ones.
        """
        spread = np.linalg.solve(self._information, slope.swapaxes(1, 2))
        covariance = np.eye(3) + slope @ spread
        scaled = np.linalg.solve(covariance, innovation[..., None])[..., 0]
        squares = (innovation * scaled).sum(axis=1) + np.linalg.slogdet(covariance)[1]
        self._squares = keep * self._squares + (squares if shows_axes else squares[0])
        self._count = keep * self._count + 3.0

    def _turn(
        self,
        end: FloatArray,  # (h, 3, 3) Rotation from the axes at the end to the initial ones
        lever: FloatArray,  # (h, 3, 3) Its integral over time, s
        error: FloatArray,  # (h, 7) Corrections of the states
        information: FloatArray,  # (h, 7, 7)
        time: float,  # Duration, s
    ) -> None:
        """Correct the states, and predict those at the end of the block."""
        assert self._down is not None
        down = self._down + np.cross(error[:, _ATTITUDE], self._down)
        down = down + np.cross((lever @ error[:, _BIAS, None])[..., 0], down)
        self._down = _unit((end.swapaxes(1, 2) @ down[..., None])[..., 0])
        self._bias = self._bias + error[:, _BIAS]
        self._slip = self._slip + error[:, _SLIP]
        back = np.tile(np.eye(len(_PRIOR)), (len(HYPOTHESES), 1, 1))
        back[:, _ATTITUDE, _ATTITUDE], back[:, _ATTITUDE, _BIAS] = end, -lever
        fade = time / LONG_MEMORY
        self._information = (1.0 - fade) * (back.swapaxes(1, 2) @ information @ back)
        self._information += fade * _PRIOR

    def wrong_axes(self, sure: float) -> WrongAxes | None:
        """Return the axes that fit better by more than `sure` standard deviations."""
        return self._by_gravity(sure) or self.by_lift(sure)

    def _by_gravity(self, sure: float) -> WrongAxes | None:
        """Return the axes with which the specific force fits straight flight better."""
        best = int(np.argmin(self._squares))
        fits = self._squares[best] < self._count  # Else the filters have lost the attitude
        axes, (_, lift) = HYPOTHESES[best], self._lift.sigmas
        contradicted = axes.gyro[1] * axes.ahead < 0 and lift < -SURE
        if best == 0 or not fits or contradicted:
            return None
        # Likelihood ratio; innovations larger than assumed count by their ratio
        configured, other = self._count + self._squares[[0, best]]
        sigma = float(np.sqrt(self._count * np.log(configured / other)))
        evidence = "rotated by the gyro, the specific force fits straight flight better so"
        return WrongAxes(axes, sigma, evidence) if sigma > sure else None

    def by_lift(self, sure: float) -> WrongAxes | None:
        """Return the axes with which lift and side force oppose the flow."""
        side, lift = self._lift.sigmas.tolist()
        axes, sigma = _LEVEL[int(lift > side)], max(side, lift)
        if side > 0.0 and lift > 0.0:  # Independent, and both wrong
            axes, sigma = _BACKWARDS, (side + lift) / math.sqrt(2.0)
        evidence = "as configured, lift or side force drives the flow, which it opposes in reality"
        return WrongAxes(axes, sigma, evidence) if sigma > sure else None


def _slipping(
    turns: FloatArray,  # (h, k, 3, 3) Rotations to the initial axes
    steps: FloatArray,  # (k,) Durations of the samples, s
    force: FloatArray,  # (k, 3) Specific force, m/s^2, FRD
    airspeed: float,  # True, m/s
) -> FloatArray:
    """Return the rate at which the velocity of a sideslip by the side force changes, (h, k, 3).

    It is for a sideslip of 1 rad per m/s^2, in the initial axes; zero at the first sample.
    """
    velocity = airspeed * turns[..., 1] * force[:, 1, None]
    change = np.diff(velocity, axis=1, prepend=velocity[:, :1])
    return np.asarray(change / steps[:, None])


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
