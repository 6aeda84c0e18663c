# SPDX-License-Identifier: Apache-2.0
"""Noise-free record of a simulated flight."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.samples import NS, NS_PER_S
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.channels import PLAIN, ChannelSet


class SimulationError(ValueError):
    """Refusal or failure of a simulation; the message names the cause and the cure.

    Every module of this package may raise it.
    """


IntArray = NDArray[np.int64]

EPOCH_NS = 1_700_000_000 * 10**9
"""Stamp of the first sample of every simulated flight, ns (14 November 2023)."""


STEP_TOLERANCE = 1e-6
"""Largest distance of a time from the simulation's time grid, in steps."""


def stamps(seconds: FloatArray) -> IntArray:
    """Return the stamps, ns, of times after the first sample of a flight, s."""
    return EPOCH_NS + np.asarray(np.rint(seconds * NS_PER_S), dtype=np.int64)


def whole_steps(time: float, rate: float, what: str) -> int:
    """Return the number of steps in a time (s) at a rate (Hz); `what` names it in messages."""
    steps = time * rate
    if not (steps >= 0.0 and abs(steps - round(steps)) < STEP_TOLERANCE * max(1.0, steps)):
        raise SimulationError(f"{what} is no whole number of simulation steps of {1e3 / rate:g} ms")
    return round(steps)


def check_positive(spec: object, *names: str, or_zero: bool = False) -> None:
    """Raise SimulationError unless the named fields are finite and positive, or zero or None."""
    for name in names:
        value = getattr(spec, name)
        if not (0.0 < (value or 0.0) < math.inf or (or_zero and not value)):
            wanted = "0 or more" if or_zero else "positive"
            raise SimulationError(f"{name} is {value}: it must be {wanted}")


@dataclass(frozen=True)
class CoefficientChange:
    """Change of coefficients by factors at a time."""

    time: float  # Time of the change, s after the first sample
    # Factor by coefficient name, such as ``pdot/da``
    factors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Flight:
    """Noise-free record of a flight, aircraft body axes (FRD), SI units."""

    name: str  # Name of the flight or vehicle
    t_ns: IntArray  # (N,) Times of the samples below, ns
    rates: FloatArray  # (N, 3) p, q, r, rad/s
    # (N, 3) Their derivatives, rad/s^2; right-hand limit where an input switches
    angular_acceleration: FloatArray
    specific_force: FloatArray  # (N, 3) Specific force at the centre of gravity, m/s^2
    # (M,) Times at which the actuator values below were commanded, ns. Each is held until the next
    # and acts `delay` later.
    actuator_t_ns: IntArray
    inputs: FloatArray  # (M, 4) Commands as deviations from trim, de, dr, da (rad), dth
    injected: FloatArray  # (M, 4) Excitation within `inputs`; the rest is the autopilot's
    trim: FloatArray  # (4,) Trim of the inputs: the channels carry `inputs` plus trim
    channel_set: ChannelSet = PLAIN  # Kind of the raw actuator channels
    delay: float = 0.0  # Transport delay from command to surface, s
    time_constant: float = 0.0  # First-order lag of the servos, s
    structure: str = ""  # Structure of `coefficients`; empty for a nonlinear aircraft
    # (3, n) True coefficient matrix at the start; None for a nonlinear aircraft
    coefficients: FloatArray | None = None
    changes: tuple[CoefficientChange, ...] = ()  # Its changes in flight
    # True local derivatives of a nonlinear aircraft, by name
    local_truth: dict[str, float] = field(default_factory=dict)
    airspeed: FloatArray | None = None  # (N,) True airspeed, m/s
    # Parameters of the identifier for this aircraft, by name
    parameters: dict[str, Any] = field(default_factory=dict)
    # More true signals of length N, such as ``alpha`` and ``beta`` (rad) and the surfaces
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def rate(self) -> float:
        """Sample rate, Hz."""
        return NS_PER_S * (len(self.t_ns) - 1) / float(self.t_ns[-1] - self.t_ns[0])

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.t_ns[-1] - self.t_ns[0]) * NS

    @property
    def time(self) -> FloatArray:
        """Times of the samples since the first one, s."""
        return np.asarray((self.t_ns - self.t_ns[0]) * NS)

    @property
    def channel_trim(self) -> FloatArray:
        """Return the raw channels in trimmed flight, shape (C,)."""
        return self.channel_set.trim(self.trim)

    def force_at(
        self,
        # (3,) Position r of the point from the centre of gravity, FRD, m. The rotation adds
        # ``wdot x r + w x (w x r)``
        lever_arm: FloatArray | tuple[float, float, float],
    ) -> FloatArray:
        """Return the specific force at a body-fixed point, shape (N, 3), m/s^2."""
        arm = np.asarray(lever_arm, dtype=np.float64)
        swing = np.cross(self.rates, np.cross(self.rates, arm))
        turn = np.cross(self.angular_acceleration, arm)
        return np.asarray(self.specific_force + turn + swing, dtype=np.float64)

    def coefficients_at(self, time: float) -> FloatArray:
        """Return the true coefficients at `time` (s after the first sample), shape (3, n)."""
        assert self.coefficients is not None
        return changed_coefficients(self.structure, self.coefficients, self.changes, time)


def changed_coefficients(
    structure: str, coefficients: FloatArray, changes: tuple[CoefficientChange, ...], time: float
) -> FloatArray:
    """Return the coefficients after all changes up to `time` (s), shape (3, n)."""
    a = np.array(coefficients, dtype=np.float64)
    for change in changes:
        if change.time <= time:
            for name, factor in change.factors.items():
                a[STRUCTURES[structure].index(name)] *= factor
    return a
