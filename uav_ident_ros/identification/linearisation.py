# SPDX-License-Identifier: Apache-2.0
"""Linearisation of a model, and its modes with standard deviations.

The state is ``[p q r beta alpha phi]``, of small deviations from a flight condition. The modes are
the eigenvalues of the longitudinal part (q, alpha) and the lateral part (p, r, beta, phi). Their
standard deviations follow to first order from those of the coefficients (Etkin and Reid, Dynamics
of Flight, 1996, ch. 6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.scales import ROUNDING
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    LAST_COLUMNS,
    OWN_COLUMNS,
    PRODUCT_COLUMNS,
    RATE_COLUMNS,
    RATES,
    ROWS,
    FloatArray,
    Structure,
)

STATES = ("p", "q", "r", "beta", "alpha", "phi")
"""States of the linear model: rad/s and rad."""

LONGITUDINAL = [STATES.index(name) for name in ("q", "alpha")]
LATERAL = [STATES.index(name) for name in ("p", "r", "beta", "phi")]


@dataclass(frozen=True)
class Condition:
    """The flight condition to linearise about."""

    airspeed: float  # True, m/s
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)  # p, q, r, rad/s
    # Attitude, rad
    roll: float = 0.0
    pitch: float = 0.0
    # Sideslip and angle of attack, rad; zero where ay and az are zero
    beta: float = 0.0
    alpha: float = 0.0
    # Only of the author's own regressors
    inputs: tuple[float, ...] = field(default=(0.0,) * len(INPUTS), kw_only=True)


def level_flight(structure: Structure, values: FloatArray, airspeed: float) -> Condition:
    """Return steady, level flight at an airspeed, m/s, with lift equal to weight."""
    slope = float(values[structure.index("az/alpha")]) if structure.has_flow else 0.0
    return Condition(airspeed, alpha=-GRAVITY / slope if slope else 0.0)


def linearise(
    structure: Structure, values: FloatArray, condition: Condition
) -> tuple[FloatArray, FloatArray]:
    """Return A and B of ``dx/dt = A dx + B du``.

    Parameters
    ----------
    structure : Structure
        Structure of the coefficients.
    values : (R, n) array
        Coefficients.
    condition : Condition
        Flight condition; a structure without flow angles uses only the rates.

    Returns
    -------
    (6, 6) and (6, 4) arrays
        For the states p, q, r, beta, alpha, phi; (3, 3) and (3, 4) for p, q, r of a structure
        without flow angles.
    """
    p, q, r = condition.rates
    products = np.array(  # d(pq, qr, pr, pp, rr) / d(p, q, r)
        [[q, p, 0.0], [0.0, r, q], [r, 0.0, p], [2.0 * p, 0.0, 0.0], [0.0, 0.0, 2.0 * r]]
    )
    moments = values[: len(ROWS)]
    by_rates, by_inputs = _own_slopes(structure, condition)
    rates = moments[:, RATE_COLUMNS] + moments[:, PRODUCT_COLUMNS] @ products
    rates += moments[:, OWN_COLUMNS] @ by_rates
    inputs = moments[:, INPUT_COLUMNS] + moments[:, OWN_COLUMNS] @ by_inputs
    if not structure.has_flow:
        return rates, inputs
    a, b = np.zeros((6, 6)), np.zeros((6, 4))
    a[:3, :3] = rates
    a[:3, 3:5] = moments[:, LAST_COLUMNS]
    b[:3] = inputs
    for k, flow in enumerate(structure.flow):
        force, missing = values[flow.force] / condition.airspeed, values[flow.kinematics]
        a[3 + k, :3] = force[RATE_COLUMNS] + missing[RATE_COLUMNS]
        a[3 + k, 3 + k] = force[flow.angle]
        b[3 + k] = force[INPUT_COLUMNS]
    sine, cosine = math.sin(condition.roll), math.cos(condition.roll)
    lift = GRAVITY * math.cos(condition.pitch) / condition.airspeed
    a[3, 0] += condition.alpha
    a[3, 2] -= 1.0
    a[3, 4] += p
    a[4, 0] -= condition.beta
    a[4, 1] += 1.0
    a[4, 3] -= p
    a[3, 5], a[4, 5] = lift * cosine, -lift * sine
    slope = math.tan(condition.pitch)
    a[5, :3] = 1.0, slope * sine, slope * cosine
    a[5, 5] = slope * (q * cosine - r * sine)
    return a, b


def _own_slopes(structure: Structure, condition: Condition) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of the author's own regressors by rates, (k, 3), and inputs, (k, 4)."""
    if not structure.own:
        return np.zeros((0, len(RATES))), np.zeros((0, len(INPUTS)))
    ahead = ROUNDING * np.eye(len(RATES) + len(INPUTS))
    point = np.array((*condition.rates, *condition.inputs))
    x, u = np.split(np.stack((point + ahead, point - ahead)), [len(RATES)], axis=2)
    after, before = structure.own_values(x, u)
    by_rates, by_inputs = np.split((after - before).T / (2.0 * ROUNDING), [3], axis=1)
    return by_rates, by_inputs


def damping(structure: Structure, values: FloatArray, airspeed: float) -> FloatArray:
    """Return the damping of roll, pitch and yaw at an airspeed in m/s, 1/s, (3,).

    With flow angles those of pitch and yaw include the damping of alpha and beta: they are twice
    damping ratio times frequency of the short period and the Dutch roll.
    """
    settling = -np.diag(values[: len(ROWS), RATE_COLUMNS])
    for row, flow in zip((2, 1), structure.flow, strict=False):  # yaw: beta, pitch: alpha
        settling[row] -= values[flow.force, flow.angle] / airspeed
    return settling


@dataclass(frozen=True)
class Mode:
    """A mode of the linear model: name, eigenvalue, and frequency and damping or time constant."""

    # ``short period``, ``dutch roll``, ``roll``, ``spiral``; ``longitudinal`` or ``lateral`` if
    # the eigenvalues do not have this classical pattern
    name: str
    eigenvalue: complex  # 1/s; of a pair the one above the real axis
    eigenvalue_sigma: tuple[float, float]  # Of its real and imaginary part, 1/s
    # Natural frequency, rad/s, and damping ratio of an oscillation; NaN for a real mode
    frequency: float = math.nan
    frequency_sigma: float = math.nan
    damping: float = math.nan
    damping_sigma: float = math.nan
    # Time constant of a real mode, s; negative if unstable. NaN for an oscillation
    time_constant: float = math.nan
    time_constant_sigma: float = math.nan


def modes(
    structure: Structure, values: FloatArray, sigma: FloatArray, condition: Condition
) -> list[Mode]:
    """Return the modes of a model with flow angles, longitudinal ones first."""
    a, _ = linearise(structure, values, condition)
    variance = np.zeros_like(a)  # Of A, for independent coefficients
    for index in structure.free:
        moved = values.copy()
        moved[index] += sigma[index]
        variance += (linearise(structure, moved, condition)[0] - a) ** 2
    spread = np.sqrt(variance)
    found = []
    for part, name in ((LONGITUDINAL, "longitudinal"), (LATERAL, "lateral")):
        pick = np.ix_(part, part)
        eigenvalues, right = np.linalg.eig(a[pick])
        left = np.linalg.inv(right)
        order = np.argsort(eigenvalues.real)
        chosen = [int(k) for k in order if eigenvalues[k].imag >= 0.0]
        names = _names(name, [complex(eigenvalues[k]) for k in chosen])
        for k, label in zip(chosen, names, strict=True):
            # d lambda / d a_ij = w_i v_j, with w, v the left and right eigenvectors
            slope = np.outer(left[k], right[:, k])
            found.append(_mode(label, complex(eigenvalues[k]), slope, spread[pick]))
    return found


def level_modes(
    structure: Structure, values: FloatArray, sigma: FloatArray, airspeed: float
) -> list[Mode]:
    """Return the modes in level flight at an airspeed, m/s.

    The list is empty without flow angles, and for a model without a finite linearisation.
    """
    if not airspeed > 0.0 or not structure.has_flow:
        return []
    try:
        with np.errstate(all="ignore"):
            return modes(structure, values, sigma, level_flight(structure, values, airspeed))
    except np.linalg.LinAlgError:
        return []


def _names(part: str, eigenvalues: list[complex]) -> list[str]:
    """Return the names of one part's modes: one eigenvalue of each pair, fastest decay first."""
    oscillating = [value.imag > 0.0 for value in eigenvalues]
    if part == "longitudinal":
        return ["short period"] if oscillating == [True] else [part] * len(eigenvalues)
    real = iter(("roll", "spiral"))
    if sorted(oscillating) == [False, False, True]:
        return ["dutch roll" if pair else next(real) for pair in oscillating]
    return [part] * len(eigenvalues)


def _mode(name: str, value: complex, slope: NDArray[np.complex128], spread: FloatArray) -> Mode:
    """Return one mode, with standard deviations to first order."""

    def sigma(gradient: FloatArray) -> float:
        return float(np.sqrt(((gradient * spread) ** 2).sum()))

    real = sigma(slope.real)
    if value.imag == 0.0:
        constant = -1.0 / value.real if value.real else math.inf
        return Mode(
            name,
            value,
            (real, 0.0),
            time_constant=constant,
            time_constant_sigma=abs(constant / value.real) * real if value.real else math.inf,
        )
    size = abs(value)
    by_size = (value.real * slope.real + value.imag * slope.imag) / size
    by_damping = -slope.real / size + (value.real / size) * (by_size / size)
    return Mode(
        name,
        value,
        (real, sigma(slope.imag)),
        frequency=size,
        frequency_sigma=sigma(by_size),
        damping=-value.real / size,
        damping_sigma=sigma(by_damping),
    )
