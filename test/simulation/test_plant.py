# SPDX-License-Identifier: Apache-2.0
import dataclasses
import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.flight import CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.plant import PAPER_PRINTED, SMALL_UAV, PlantFlight

BIG = {"de": 0.25, "dr": 0.35, "da": 0.35, "dth": 0.3}
EXCITED = (Segment("multisine", amplitudes=BIG, period=5.0, band=(0.2, 3.0)),)


def surfaces_at(flight: Flight, t: float) -> np.ndarray:
    """Return the held, delayed and lagged input at time t, computed independently."""
    times = (flight.actuator_t_ns - flight.actuator_t_ns[0]) * 1e-9 + flight.delay
    acting = times <= t + 1e-9
    if flight.time_constant == 0.0:
        return flight.inputs[acting][-1] if acting.any() else np.zeros(4)
    value, last, target = np.zeros(4), 0.0, np.zeros(4)
    for edge, command in zip(times[acting], flight.inputs[acting], strict=True):
        value = target + (value - target) * np.exp(-(edge - last) / flight.time_constant)
        last, target = edge, command
    return target + (value - target) * np.exp(-(t - last) / flight.time_constant)


def reference(flight: Flight, gust: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the rates at `edges` by scipy, restarted at every switch of an input."""
    structure = STRUCTURES[flight.structure]
    x = flight.rates[0]
    out = [x]
    for start, end in itertools.pairwise(edges):
        a = flight.coefficients_at(start + 1e-7)

        def slope(t: float, x: np.ndarray, a: np.ndarray = a, end: float = end) -> np.ndarray:
            u = surfaces_at(flight, min(t, end - 1e-6))
            disturbance = [np.interp(t, flight.time, gust[:, i]) for i in range(3)]
            return a @ structure.regressor(x, u) + disturbance

        x = solve_ivp(slope, (start, end), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        out.append(x)
    return np.array(out)


@pytest.mark.parametrize(
    "changes",
    [
        {"time_constant": 0.05, "delay": 0.01},
        {"changes": (CoefficientChange(0.2, {"pdot/da": 0.5, "qdot/de": 0.5}),)},
        {"rate": 200.0, "max_step": 2.5e-3},
        {"initial_rates": (1.0, -0.5, 0.4), "moment": (1.0, -2.0, 0.5)},
    ],
    ids=["servo", "change", "coarse", "moment"],
)
def test_the_plant_agrees_with_scipy(changes: dict) -> None:
    spec = PlantFlight(EXCITED, 0.4, actuator_rate=50.0, **changes)
    flight = spec.fly()
    edges = np.arange(0.0, 0.4001, 0.01)
    index = np.rint(edges * flight.rate).astype(int)
    wanted = reference(flight, flight.extra["gust"], edges)
    assert np.abs(wanted).max() > 0.3
    tolerance = 1e-9 if spec.max_step <= 1e-3 else 1e-7
    np.testing.assert_allclose(flight.rates[index], wanted, rtol=0.0, atol=tolerance)


def test_gusts_enter_as_angular_acceleration() -> None:
    spec = PlantFlight((), 0.05, gusts=ColouredNoise(3.0, 0.01), seed=3)
    flight = spec.fly()
    # A gust is piecewise linear between samples: scipy restarts at each.
    wanted = reference(flight, flight.extra["gust"], flight.time)
    np.testing.assert_allclose(flight.rates, wanted, rtol=0.0, atol=1e-9)


def test_coloured_noise_has_its_rms_and_correlation_time() -> None:
    noise = ColouredNoise(2.0, 0.3).sample(400_000, 1, 200.0, np.random.default_rng(0))[:, 0]
    assert noise.std() == pytest.approx(2.0, rel=0.05)
    lag = 60  # 0.3 s
    assert np.mean(noise[lag:] * noise[:-lag]) / noise.var() == pytest.approx(np.exp(-1), abs=0.05)
    starts = [
        ColouredNoise(2.0, 0.3).sample(1, 1, 200.0, np.random.default_rng(k))[0, 0]
        for k in range(2000)
    ]
    assert np.std(starts) == pytest.approx(2.0, rel=0.06)


def test_the_autopilot_damps_the_rates_and_its_commands_are_recorded() -> None:
    start = (0.5, 0.4, 0.3)
    spec = PlantFlight((), 2.0, initial_rates=start, autopilot=True)
    free = dataclasses.replace(spec, autopilot=False).fly()
    held = spec.fly()
    np.testing.assert_allclose(held.inputs[0], [0.05 * 0.4, 0.08 * 0.3, -0.03 * 0.5, 0.0])
    turned = held.rates[:30:10, 1].sum() * 0.01  # the autopilot's integral of q
    assert held.inputs[3, 0] == pytest.approx(0.05 * held.rates[30, 1] + 0.15 * turned)
    early = slice(50, 300)
    assert np.all(np.abs(held.rates[early]).sum(axis=0) < np.abs(free.rates[early]).sum(axis=0))
    assert abs(held.rates[:, 1].sum()) < 0.8 * abs(free.rates[:, 1].sum())  # pitch returns
    replayed = reference(held, held.extra["gust"], np.arange(0.0, 0.2001, 0.01))
    np.testing.assert_allclose(held.rates[:201:10], replayed, rtol=0.0, atol=1e-9)


def test_the_plants_have_their_published_coefficients() -> None:
    a, index = SMALL_UAV.coefficients, STRUCTURES["throttle_coupled"].index
    assert a[index("pdot/p")] == pytest.approx(-10.0, rel=0.01)
    assert a[index("qdot/pp")] == -a[index("qdot/rr")]
    assert a[index("rdot/qr")] == pytest.approx(-a[index("pdot/pq")])
    printed = PAPER_PRINTED.coefficients
    assert printed[index("pdot/p")] == -0.1361
    assert printed[index("pdot/pq")] == pytest.approx(0.0010 * 57.29578)
