# SPDX-License-Identifier: Apache-2.0
"""A linear aircraft for closed-loop tests of controllers, and messages with its coefficients."""

from collections.abc import Callable, Sequence

import numpy as np
from equations import matrix

from uav_ident_ros.client import Coefficients, CoefficientSource, Fallback
from uav_ident_ros.control import IncrementalLaw, RateController
from uav_ident_ros.control.controller import Law
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.structure import INPUT_COLUMNS, STRUCTURES, FloatArray

STRUCTURE = STRUCTURES["flight_dynamics"]
FLOW = FlowState(0.0, 0.0, 0.0, 0.0, roll=0.0, pitch=0.0, airspeed=50.0)
DT_NS = 10_000_000
DELAY_STEPS = 2
SUBSTEPS = 4
START = 1_700_000_000 * 10**9
LIMITS = np.array([[-0.4, -0.3, -0.3, 0.0], [0.4, 0.3, 0.3, 0.0]])
STEP = np.array([0.3, 0.1, 0.05])
VALUES = {
    "pdot/p": -6.4, "pdot/da": 29.5, "qdot/q": -5.5, "qdot/de": -26.0,
    "rdot/r": -0.5, "rdot/dr": -4.3, "rdot/p": -0.3, "pdot/dr": 3.0, "pdot/pq": 0.2,
}  # fmt: skip


def coefficients(effect: FloatArray | float = 1.0, t_ns: int = START) -> Coefficients:
    """Coefficients with control derivatives (de, dr, da, dth) times `effect`."""
    values = matrix(STRUCTURE, VALUES)
    values[:, INPUT_COLUMNS] *= effect
    return Coefficients(STRUCTURE, values, 0.02 * np.abs(values), flow=FLOW, t_ns=t_ns)


def controller(
    law: Law = IncrementalLaw, speed: float = 1.0, delay_setting: int = DELAY_STEPS, **options: bool
) -> tuple[RateController, CoefficientSource]:
    """Return a controller with the healthy set as its nominal one, and its coefficient source.

    The gains are `speed` times as fast as usual; the delay is `delay_setting` samples.
    """
    nominal = coefficients()
    source = CoefficientSource(Fallback.LAST_GOOD, nominal)
    gains, delay = law.gains.times(speed), delay_setting * DT_NS * 1e-9
    return RateController(source, nominal, LIMITS, delay, law, gains=gains, **options), source


def a_sample_later(
    x: FloatArray, u: FloatArray, plant: FloatArray, push: FloatArray | float = 0.0
) -> FloatArray:
    """Return the plant's rates a sample later, by Euler steps."""
    for _ in range(SUBSTEPS):
        f = STRUCTURE.regressor(x, u, np.zeros(2))
        x = x + DT_NS * 1e-9 / SUBSTEPS * (plant[:3] @ f + push)
    return x


def flown(
    flying: RateController,
    effect: Callable[[float], FloatArray | float] | float = 1.0,
    reference: Callable[[float], FloatArray] | FloatArray = STEP,
    seconds: float = 4.0,
    disturbance: Sequence[float] | FloatArray = (0.0, 0.0, 0.0),  # or (N, 3), per sample
    noise: float = 0.0,
    each: Callable[[int], None] = lambda t_ns: None,
    delay_steps: int = DELAY_STEPS,  # True delay; the controller assumes `DELAY_STEPS`
) -> FloatArray:
    """Return the rates of the plant, (N, 3); `effect` may be a function of time."""
    rng, healthy = np.random.default_rng(1), coefficients().values
    x, underway, rates = np.zeros(3), [np.zeros(4)] * delay_steps, []
    for k in range(round(seconds * 1e9 / DT_NS)):
        t = k * DT_NS * 1e-9
        rates.append(x)
        wanted = reference(t) if callable(reference) else (reference if t > 0.5 else np.zeros(3))
        each(START + k * DT_NS)
        measured = x + noise * rng.standard_normal(3)
        underway.append(flying.update(START + k * DT_NS, measured, wanted))
        u = underway.pop(0)
        push = np.atleast_2d(disturbance)[k % len(np.atleast_2d(disturbance))]
        plant = healthy.copy()
        plant[:, INPUT_COLUMNS] *= effect(t) if callable(effect) else effect
        x = a_sample_later(x, u, plant, push)
    return np.array(rates)
