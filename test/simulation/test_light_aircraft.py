# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest

from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.flight import GRAVITY, CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.light_aircraft import TRUTH, LightFlight, fly

EXCITATION = Segment("multisine", amplitudes={"de": 0.03, "dr": 0.04, "da": 0.03})
REGRESSORS = {
    "pdot": ("p", "r", "dr", "da", "beta", "dth", "qr", "1"),
    "qdot": ("q", "de", "alpha", "dth", "pr", "1"),
    "rdot": ("p", "r", "dr", "da", "beta", "dth", "pq", "1"),
    "ay": ("beta", "dr", "1"),
    "az": ("alpha", "de", "1"),
}


def derivatives(flight: Flight) -> dict[str, float]:
    """Regress the noise-free accelerations and forces."""
    p, q, r = flight.rates.T
    columns = dict(zip(("de", "dr", "da", "dth"), flight.extra["surfaces"].T, strict=True))
    columns |= {"p": p, "q": q, "r": r, "qr": q * r, "pr": p * r, "pq": p * q}
    columns |= {"1": np.ones_like(p), "beta": flight.extra["beta"], "alpha": flight.extra["alpha"]}
    signals = np.column_stack([flight.angular_acceleration, flight.specific_force[:, 1:]])
    out = {}
    for (row, names), signal in zip(REGRESSORS.items(), signals.T, strict=True):
        matrix = np.column_stack([columns[name] for name in names])
        values = np.linalg.lstsq(matrix, signal, rcond=None)[0]
        out |= {f"{row}/{name}": float(v) for name, v in zip(names, values, strict=True)}
    return out


def test_the_aircraft_has_the_derivatives_that_it_says() -> None:
    found = derivatives(fly(LightFlight((EXCITATION,), 40.0)))
    for name, value in TRUTH.items():
        assert found[name] == pytest.approx(value, rel=0.1, abs=0.1), name


def test_the_accelerations_are_the_slope_of_the_rates() -> None:
    flight = fly(LightFlight((EXCITATION,), 20.0))
    mean = 0.5 * (flight.angular_acceleration[1:] + flight.angular_acceleration[:-1])
    slope = np.diff(flight.rates, axis=0) * flight.rate
    error = np.sqrt(np.mean((slope - mean) ** 2, axis=0)) / slope.std(axis=0)
    assert error.max() < 0.1


def test_level_flight_carries_the_weight_and_turns_carry_more() -> None:
    level = fly(LightFlight((), 10.0))
    np.testing.assert_allclose(level.specific_force.mean(axis=0), [0.0, 0.0, -GRAVITY], atol=0.1)
    turn = fly(LightFlight((), 10.0, bank=40.0))
    late = turn.time > 6.0
    roll = turn.extra["roll"][late].mean()
    assert math.radians(30.0) < roll < math.radians(45.0)
    assert turn.specific_force[late, 2].mean() == pytest.approx(-GRAVITY / math.cos(roll), rel=0.1)
    speed = turn.airspeed[late].mean()
    sideways = turn.specific_force[late, 1].mean() + GRAVITY * math.sin(roll)
    assert turn.rates[late, 2].mean() == pytest.approx(sideways / speed, rel=0.05)


def test_a_reversed_rudder_yaws_the_other_way() -> None:
    pulse = Segment("doublet", 1.0, 3.0, {"dr": 0.05})
    reversed_ = (CoefficientChange(0.0, {"dr": -1.0}),)
    healthy, failed = (
        fly(LightFlight((pulse,), 3.0, changes=changes, yaw_damper=0.0)).rates[:, 2]
        for changes in ((), reversed_)
    )
    np.testing.assert_allclose(healthy[:320], -failed[:320], atol=0.02)
    assert np.abs(healthy).max() > 0.05


def test_impossible_flights_are_refused() -> None:
    with pytest.raises(SimulationError, match="no whole number"):
        fly(LightFlight((), 1.0, actuator_rate=60.0))
    with pytest.raises(SimulationError, match="lost"):
        fly(LightFlight((Segment("doublet", amplitudes={"da": 1.5}, unit=2.0),), 10.0))
