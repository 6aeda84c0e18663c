# SPDX-License-Identifier: Apache-2.0
"""Delay and lag from the response to injected signals: right in gusts, unknown without one."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from flying import flight_of, identified, light_errors, light_measured, with_injected
from scipy.signal import lfilter

from uav_ident_ros.identification.delay import APART, LAGS, STEP, SYSTEMATIC_ERROR, by_injection
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.injected_response import Found, InjectedResponse
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.quadrotor_flight import Body, QuadrotorFlight

DELAYS = STEP * np.arange(-6, 13)
FINE = 5
"""Steps of integration in a step of the grid."""


def closed_loop(
    delay: float, lag: float, gusts: float = 0.0, feedback: float = 0.3, peak: float = 0.1
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rates and forces, inputs and injected signals, of three first-order axes."""
    h, rng = STEP / FINE, np.random.default_rng(1)
    peaks = dict.fromkeys(("de", "dr", "da"), peak)
    segment = Segment("multisine", 0.0, 40.0, peaks, 10.0, (0.2, 4.0), seed=1)
    given = segment.sample(h * np.arange(round(40.0 / h)))[:, [2, 0, 1]]
    noise = ColouredNoise(gusts, 0.3).sample(len(given), 3, 1.0 / h, rng)
    late, keep = round(delay / h), math.exp(-h / lag) if lag else 0.0
    x, u, moved = np.zeros((len(given) + 1, 3)), np.zeros((len(given), 3)), np.zeros(3)
    for k in range(len(given)):
        u[k] = given[k] - feedback * x[k]
        moved = keep * moved + (1.0 - keep) * (u[k - late] if k >= late else 0.0)
        x[k + 1] = x[k] + h * (20.0 * moved - 4.0 * x[k] + noise[k])

    def means(v: FloatArray) -> FloatArray:
        steps = v.reshape(-1, FINE, 3).mean(axis=1)
        return np.column_stack((steps[:, 1], steps[:, 2], steps[:, 0], np.zeros(len(steps))))

    edges = np.column_stack((x[::FINE], np.zeros((len(x[::FINE]), 2))))
    return edges, means(u), means(given)


def found(
    x: FloatArray, u: FloatArray, injected: FloatArray, lag: float = 0.0, **search: Any
) -> Found | None:
    """Search delay and lag as the bank of models does."""
    response = InjectedResponse()
    for k in range(0, len(u) - 200 + 1, 200):
        own = slice(k, k + 200)
        response.add(x[k : k + 201], u[own], injected[own], lag)
    steps = response.find(DELAYS, search.get("lags", LAGS), APART * STEP)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            answer: Found | None = end.value
            return answer


@pytest.mark.parametrize("gusts", [0.0, 0.5])
@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.1, 0.0), (0.06, 0.06), (0.02, 0.08)])
def test_delay_and_lag_are_found_in_closed_loop(delay: float, lag: float, gusts: float) -> None:
    by = found(*closed_loop(delay, lag, gusts))
    assert by is not None
    own, sigma = by.lag
    assert abs(by.total - delay - lag) < 3.0 * math.hypot(by.covariance[0, 0] ** 0.5, 0.004)
    assert abs(own - lag) < 3.0 * math.hypot(sigma, 0.004)
    assert by_injection(by, by, 0.0).total_sure


def test_the_lag_in_use_is_removed_and_a_given_lag_determines_the_delay() -> None:
    x, u, injected = closed_loop(0.04, 0.06)
    keep = math.exp(-STEP / 0.06)
    slow = lfilter([1.0 - keep], [1.0, -keep], u, axis=0)
    plain, undone = found(x, u, injected), found(x, slow, injected, lag=0.06)
    with_lag = found(x, u, injected, lags=(0.06,))
    assert plain and undone and with_lag
    # held inputs and decaying ones differ by half a step
    assert undone.total == pytest.approx(plain.total, abs=0.7 * STEP)
    assert undone.lag[0] == pytest.approx(plain.lag[0], abs=0.01)
    estimate = by_injection(plain, with_lag, 0.06)
    assert estimate.delay == pytest.approx(0.04, abs=SYSTEMATIC_ERROR)
    assert estimate.lag_sure and estimate.lag == pytest.approx(0.06, abs=SYSTEMATIC_ERROR)
    assert with_lag.lag == (pytest.approx(0.06), 0.0)


@pytest.mark.parametrize("gusts", [0.1, 5.0])
def test_signals_that_were_not_injected_leave_delay_and_lag_unsure(gusts: float) -> None:
    """The autopilot ignores the excitation messages; its inputs are feedback to gusts."""
    x, u, _ = closed_loop(0.06, 0.0, gusts, peak=0.0)
    by = found(x, u, closed_loop(0.0, 0.0)[2])
    assert by is None or not by_injection(by, by, 0.0).sure


@cache
def hovering(
    lag: float, gusts: float, in_use: float, published: bool = True, **changes: Any
) -> OnlineIdentifier:
    """Return an identifier after an excited hover in gusts."""
    peaks = {"de": 0.02, "dr": 0.05, "da": 0.02}
    segments = (Segment("multisine", 2.0, 38.0, peaks, 10.0, (0.2, 4.0), seed=1),)
    noise = ColouredNoise(gusts, 0.3)
    flight = flight_of(
        QuadrotorFlight(segments, 40.0, 500.0, delay=0.012, time_constant=lag, gusts=noise, seed=1)
    )
    m = measure(flight, Sensors(rate=100.0, gyro_noise=0.01))
    own = {"actuators__delay": 0.0, "actuators__time_constant": in_use, **changes}
    return identified(m, stream=with_injected(m) if published else None, **own)[0]


@pytest.mark.parametrize("in_use", [0.0, 0.08])
def test_the_lag_of_motors_is_estimated_in_hover_in_gusts(in_use: float) -> None:
    """Without the injected signals the lag stays unsure; prediction is 50 ms off."""
    estimate = hovering(0.05, 0.5, in_use).delays.estimate
    assert estimate.lag_sure and estimate.lag == pytest.approx(0.05, rel=0.15)
    assert estimate.total == pytest.approx(0.062, abs=0.015)
    assert estimate.lag_off(0.05) == 0.0 and estimate.lag_off(in_use)
    assert not hovering(0.05, 0.5, 0.0, published=False).delays.estimate.lag_sure


def test_an_estimated_lag_is_used_where_the_delay_is_estimated() -> None:
    """The control derivatives are then those of the quadrotor."""
    fixed = hovering(0.05, 0.5, 0.0)
    assert (fixed.delay, fixed.lag) == (0.0, 0.0)
    found = hovering(0.05, 0.1, 0.0, actuators__estimate_delay=True)
    assert found.lag == pytest.approx(0.05, rel=0.15)
    assert found.delay + found.lag == pytest.approx(0.062, abs=0.005)
    names, true = found.structure, Body().derivatives()
    learned = found.coefficient_set()
    roll = learned.values[names.index("pdot/da")]
    assert roll == pytest.approx(true["pdot/da"], rel=0.15)  # without the lag 20 % too small
    for name in ("pdot/da", "qdot/de", "rdot/dr"):
        error = abs(learned.values[names.index(name)] - true[name])
        assert error < 2.0 * learned.sigma[names.index(name)], name
    resumed = OnlineIdentifier(found.settings)
    resumed.resume(found.coefficient_set(), found.delay, found.lag)
    assert (resumed.delay, resumed.lag) == (found.delay, found.lag)
    found.reset()
    assert (found.delay, found.lag) == (0.0, 0.0)


@pytest.mark.parametrize(("lag", "configured"), [(0.03, 0.09), (0.05, 0.12)])
def test_without_flow_angles_an_injected_signal_shows_a_wrong_lag_of_the_motors(
    lag: float, configured: float
) -> None:
    """A lag that is too long multiplies the control derivatives by 1.5."""
    hover = hovering(lag, 0.1, configured, actuators__delay=0.012)
    learned, true = hover.coefficient_set(), Body().derivatives()
    for row, name in enumerate(("pdot/da", "qdot/de")):
        place = hover.structure.index(name)
        error = abs(learned.values[place] - true[name])
        assert 0.4 * abs(true[name]) < error < 2.0 * learned.sigma[place]
        assert f"'actuators.time_constant' to {lag:.2f}" in hover.setup_doubts[row]


@pytest.mark.parametrize(
    ("flown", "estimated", "usable"),
    [
        ({"gust": 0.8}, False, True),  # the injected signal leaves the lag unsure by 30 ms
        ({}, True, True),
        ({"seconds": 60.0, "time_constant": 0.07}, True, False),
    ],
    ids=["configured, in gusts", "none", "a long one"],
)
def test_only_a_long_unseparated_lag_makes_the_rows_unusable(
    flown: dict[str, float], estimated: bool, usable: bool
) -> None:
    """Lag and delay of the same length differ to second order. A configured lag counts as right."""
    m = light_measured(**{"seconds": 45.0, "bank": 20.0, "delay": 0.02, **flown})
    configured = {"actuators__time_constant": 0.0, "actuators__estimate_delay": True}
    own = configured if estimated else {}
    identifier, (*_, last) = identified(m, stream=with_injected(m), **own)
    assert identifier.delays.estimate.from_injected
    assert identifier.lag == 0.0 and last.usable == usable, last.reason
    assert (light_errors(last, "pdot/da", "qdot/de", "rdot/dr")[1] < 2.0).all()


def test_the_lag_in_use_is_at_most_the_sum_of_lag_and_delay() -> None:
    """A lag of 0.05 s without such a servo would bias pdot/da by two thirds."""
    m = light_measured(45.0, bank=20.0, delay=0.02, seed=4)
    fixed = {"actuators__time_constant": 0.05, "actuators__delay": 0.0}
    configured = fixed | {"actuators__estimate_delay": True}
    identifier, (*_, last) = identified(m, stream=with_injected(m), **configured)
    assert identifier.lag < 0.035
    relative, _ = light_errors(last, "pdot/da")
    assert (relative < 0.25).all()
