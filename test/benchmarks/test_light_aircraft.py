# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from light_aircraft import TRUTH, LightFlight

from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment

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


def test_the_aircraft_has_its_declared_derivatives() -> None:
    found = derivatives(LightFlight((EXCITATION,), 40.0).fly())
    for name, value in TRUTH.items():
        assert found[name] == pytest.approx(value, rel=0.1, abs=0.1), name
