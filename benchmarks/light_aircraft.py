# SPDX-License-Identifier: Apache-2.0
"""A light aircraft of 3 kg in six degrees of freedom, with aerodynamics linear in the flow angles.

Moments and forces are linear in rates, sideslip, angle of attack and surfaces, scaled with dynamic
pressure. The equations of motion are those of a rigid body under gravity (Stevens and Lewis,
"Aircraft Control and Simulation"). The true derivatives are known. As in a real flight, the forces
depend on the flow, and the autopilot feeds back.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import INPUTS, ROWS, FloatArray
from uav_ident_ros.simulation.flight import CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import ColouredNoise
from uav_ident_ros.simulation.live import Live, Plan
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.plant import DEFAULT_TRIM

SPEED = 20.0
"""True airspeed in trim, m/s."""

TRUTH: dict[str, float] = {
    "pdot/p": -9.0, "pdot/r": 2.0, "pdot/beta": -25.0, "pdot/dr": 3.0, "pdot/da": 45.0,
    "qdot/q": -6.0, "qdot/alpha": -40.0, "qdot/de": -30.0,
    "rdot/p": -0.5, "rdot/r": -1.8, "rdot/beta": 12.0, "rdot/dr": -9.0, "rdot/da": -1.5,
    "ay/beta": -12.0, "ay/dr": 5.0,
    "az/alpha": -190.0, "az/de": -15.0,
}  # fmt: skip
"""Derivatives in trim, 1/s or 1/s^2 per rad, m/s^2 per rad. `alpha` is zero in trim."""

_QR, _PR, _PQ = -0.70, 0.85, -0.25
"""Inertial coupling of roll, pitch and yaw, from the inertias."""

_DRAG, _AX_ALPHA, _AX_THROTTLE = 1.5, 4.0, 3.0
"""Drag in trim, m/s^2, forward force per rad and per unit of throttle."""

TURN_TIME = 10.0
"""Time of each of the alternating turns, s."""

GUST_TIME, ROLL_GUST_TIME = 1.5, 0.3
"""Correlation times of the wind and of its rolling component, s: 30 m and 6 m of flight."""

TIME_TOLERANCE = 1e-9
"""Rounding tolerance for the time of a change, s."""

State = tuple[float, float, float, float, float, float, float, float, float]
"""Rates p q r (rad/s), velocity u v w (m/s), roll and pitch (rad), altitude (m)."""


@dataclass(frozen=True, kw_only=True)
class LightFlight(Plan):
    """Flight of the light aircraft on its autopilot."""

    rate: float = 200.0  # Of samples and integration, Hz
    actuator_rate: float = 50.0
    bank: float = 0.0  # Bank angle of alternating turns, deg
    gust: float = 0.0  # Wind on each axis, m/s rms
    # Largest deflection of a surface, rad; it limits the commands
    travel: float = math.inf
    servo_speed: float = math.inf  # Largest speed of a surface, rad/s
    yaw_damper: float = 0.15  # Rudder per rad/s of yaw rate
    roll_gain: float = 0.2  # Aileron per rad of bank error; a tenth of it per rad/s of roll rate
    # Rolling component of the wind, rad/s per m/s: 2 / span for eddies of the size of the wing
    roll_gust: float = 0.15
    # Factors from a time on, on the effect of an input (such as ``de``) or on a whole row (such as
    # ``pdot``), as by another inertia
    changes: tuple[CoefficientChange, ...] = ()
    speed: float = SPEED  # True airspeed in trim, m/s
    derivatives: Mapping[str, float] = field(default_factory=lambda: TRUTH)  # In trim, as `TRUTH`

    def fly(self, name: str = "light_aircraft") -> Flight:
        """Simulate the flight; see `Plan.fly`."""
        live = _LiveLight(self)

        def commanded(t: float, excitation: FloatArray) -> FloatArray:
            return np.add(_autopilot(self, live.state, t), excitation)

        rows, commands, common = live.record(self, commanded)
        u, v, w, roll, pitch, altitude = rows[:, 9:15].T
        speed = np.linalg.norm(rows[:, 9:12], axis=1)
        return Flight(
            name=name,
            specific_force=rows[:, 6:9],
            inputs=commands,
            trim=np.array(DEFAULT_TRIM),
            changes=self.changes,
            local_truth=dict(self.derivatives),
            airspeed=speed,
            extra={
                "alpha": np.arctan2(w, u),
                "beta": np.arcsin(v / speed),
                "roll": roll,
                "pitch": pitch,
                "altitude": altitude,
                "surfaces": rows[:, 15:19],
            },
            **common,
        )


def _left(
    changes: Sequence[CoefficientChange], names: Sequence[str], time: float
) -> tuple[float, ...]:
    """Return the factors on the effects of inputs or rows at `time` (s)."""
    now = [change.factors for change in changes if change.time <= time + TIME_TOLERANCE]
    return tuple(math.prod(factors.get(name, 1.0) for factors in now) for name in names)


class _LiveLight(Live):
    """The aircraft, by the midpoint rule; a row goes on with force, state and surfaces."""

    def __init__(self, spec: LightFlight) -> None:
        super().__init__(Sensors(rate=spec.actuator_rate), spec.delay, spec.seed, spec.rate)
        self.spec = spec
        self.state: State = (0.0, 0.0, 0.0, spec.speed, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._acting = self._surface = np.zeros(len(INPUTS))
        self._wind = iter(_wind(spec, spec.samples))
        lag = spec.time_constant
        self._keep = math.exp(-1.0 / (spec.rate * lag)) if lag > 0.0 else 0.0

    def _fly(self, acting: FloatArray, moved: bool) -> tuple[float, ...]:
        spec, h, gust = self.spec, 1.0 / self.rate, next(self._wind)
        surface, before = acting + (self._surface - acting) * self._keep, self._surface
        reach = spec.servo_speed * h
        surface[:3] = np.clip(surface[:3], before[:3] - reach, before[:3] + reach)
        surface[:3] = np.clip(surface[:3], -spec.travel, spec.travel)
        self._surface = surface
        u = (surface * _left(spec.changes, INPUTS, self.time)).tolist()
        moments = _left(spec.changes, ROWS, self.time)
        slope, acceleration, force = _slope(spec, self.state, u, gust, moments)
        row = (*self.state[:3], *acceleration, *force, *self.state[3:], *surface)
        middle = tuple(x + 0.5 * h * dx for x, dx in zip(self.state, slope, strict=True))
        slope, _, _ = _slope(spec, middle, u, gust, moments)  # type: ignore[arg-type]
        self.state = tuple(x + h * dx for x, dx in zip(self.state, slope, strict=True))  # type: ignore[assignment]
        return row

    def _attitude(self) -> Sequence[float]:
        return self.state[6:8]


def _wind(spec: LightFlight, count: int) -> list[list[float]]:
    """Return the wind v, w (m/s) and its rolling p (rad/s) at each step."""
    rng = np.random.default_rng([spec.seed, 7])
    v_w = ColouredNoise(spec.gust, GUST_TIME).sample(count, 2, spec.rate, rng)
    p = ColouredNoise(spec.roll_gust * spec.gust, ROLL_GUST_TIME).sample(count, 1, spec.rate, rng)
    out: list[list[float]] = np.column_stack([v_w, p]).tolist()
    return out


def _autopilot(spec: LightFlight, state: State, t: float) -> FloatArray:
    """Return de, dr, da, dth of the autopilot: bank, altitude and speed hold, yaw damper."""
    p, q, r, u, _, w, roll, pitch, altitude = state
    side = 1.0 if int(t / TURN_TIME) % 2 == 0 else -1.0
    bank = math.radians(spec.bank) * side
    climb = u * math.sin(pitch) - w * math.cos(pitch)
    wanted = max(-0.2, min(0.2, -0.01 * altitude - 0.02 * climb + 0.1 * abs(math.sin(roll)) ** 2))
    return np.array(
        [
            0.3 * (pitch - wanted) + 0.03 * q,
            spec.yaw_damper * (r - GRAVITY / spec.speed * math.sin(roll) * math.cos(pitch)),
            spec.roll_gain * (bank - roll - 0.1 * p),
            max(-0.5, min(0.5, 0.1 * (spec.speed - u))),
        ]
    )


def _slope(
    spec: LightFlight,
    state: State,
    surfaces: Sequence[float],
    gust: Sequence[float],
    moments: Sequence[float],
) -> tuple[State, tuple[float, float, float], tuple[float, float, float]]:
    """Return the state derivative, angular acceleration, rad/s^2, and specific force, m/s^2."""
    c = spec.derivatives
    p, q, r, u, v, w, roll, pitch, _ = state
    de, dr, da, dth = surfaces
    beta, alpha = math.atan2(v + gust[0], u), math.atan2(w + gust[1], u)
    ratio = math.sqrt(u * u + v * v + w * w) / spec.speed
    pressure = ratio * ratio
    p_air = p + gust[2]
    pdot = ratio * (c["pdot/p"] * p_air + c["pdot/r"] * r)
    pdot += pressure * (c["pdot/beta"] * beta + c["pdot/dr"] * dr + c["pdot/da"] * da)
    pdot = moments[0] * (pdot + 0.5 * dth) + _QR * q * r
    qdot = ratio * c["qdot/q"] * q + pressure * (c["qdot/alpha"] * alpha + c["qdot/de"] * de)
    qdot = moments[1] * (qdot - dth) + _PR * p * r
    rdot = ratio * (c["rdot/p"] * p_air + c["rdot/r"] * r)
    rdot += pressure * (c["rdot/beta"] * beta + c["rdot/dr"] * dr + c["rdot/da"] * da)
    rdot = moments[2] * (rdot - 0.5 * dth) + _PQ * p * q
    ax = pressure * (_AX_ALPHA * alpha - _DRAG) + _DRAG + _AX_THROTTLE * dth
    ay = pressure * (c["ay/beta"] * beta + c["ay/dr"] * dr)
    az = pressure * (c["az/alpha"] * alpha + c["az/de"] * de - GRAVITY)
    sin_roll, cos_roll = math.sin(roll), math.cos(roll)
    sin_pitch, cos_pitch = math.sin(pitch), math.cos(pitch)
    return (
        (
            pdot,
            qdot,
            rdot,
            ax + r * v - q * w - GRAVITY * sin_pitch,
            ay + p * w - r * u + GRAVITY * sin_roll * cos_pitch,
            az + q * u - p * v + GRAVITY * cos_roll * cos_pitch,
            p + (q * sin_roll + r * cos_roll) * sin_pitch / cos_pitch,
            q * cos_roll - r * sin_roll,
            u * sin_pitch - (v * sin_roll + w * cos_roll) * cos_pitch,
        ),
        (pdot, qdot, rdot),
        (ax, ay, az),
    )
